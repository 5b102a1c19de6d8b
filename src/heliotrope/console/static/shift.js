// The tab of the shift: notes for those who come next, and the reports.
import { api, me, store } from "./live.js";
import { h, moment, refreshed, table } from "./dom.js";
import { act } from "./orders.js";
import { t } from "./words.js";

const DAY = 86400;

export function shift(box) {
  const notes = h("div"), now = () => store.head.utc, midnight = () => DAY * Math.floor(now() / DAY);
  const open = (title, since, until) => h("button", { className: "hx-button", onclick: () => window.open(`/report?since=${since()}&until=${until()}`, "_blank", "noopener") }, title);
  const text = h("textarea", { name: "note", maxLength: 1000, rows: 3, required: true, ariaLabel: t("Note for the next shift"), placeholder: t("What the next shift has to know") });
  const load = async () => {
    const rows = await api("GET", "journal?kind=note&limit=50");
    notes.replaceChildren(rows.length ? table([[t("Time"), (r) => moment(r.at)], ["", (r) => r.text]], rows) : h("p", { className: "hx-hint" }, t("None yet.")));
  };
  // What was typed stays until the plant has it.
  const keep = async () => { await api("POST", "notes", { text: text.value.replace(/\s+/g, " ").trim() }); text.value = ""; await load(); };
  box.append(h("h3", {}, t("Report")), h("div", { className: "hx-row hx-search" }, open(t("Last 8 hours"), () => 0, () => 0), open(t("Today"), midnight, () => 0), open(t("Yesterday"), () => midnight() - DAY, midnight)),
    h("p", { className: "hx-hint" }, t("Production, availability, calibrations, alarms, work and notes for a period, ready to print.")),
    h("h3", {}, t("Hand-over notes")),
    me.role === "viewer" ? "" : h("form", { className: "hx-note", onsubmit: (event) => { event.preventDefault(); act(keep, t("note")); } }, text, h("button", { className: "hx-button main" }, t("Save note"))), notes);
  return refreshed(load, { key: () => store.head?.events, every: 10 });
}
