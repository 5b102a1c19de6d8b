// Versions of a heliostat's parameters side by side; an engineer brings one back or types values.
import { api, me, store } from "./live.js";
import { count, h, lay, moment, number, table } from "./dom.js";
import { act, askAnd } from "./orders.js";
import { fixed, t } from "./words.js";

const UNITS = { rad: ["mrad", 1e3], m: ["mm", 1e3], 1: ["", 1] };
const shown = (value, unit) => (value === null ? "–" : fixed(value * UNITS[unit][1], 3));

// The changes that wait for a second engineer; those of one heliostat if it is named.
export async function waitingChanges(name) {
  const all = store.head?.changes ? await api("GET", "parameters/waiting") : [];
  return name === undefined ? all : all.filter((one) => one.heliostat === name);
}

// What is asked for, by whom and why, with the buttons of whoever may decide.
export function waitingView(one, buttons = true) {
  const path = `parameters/waiting/${one.number}`, mine = one.author === me.name, does = (title, go, main) => h("button", { className: `hx-button ${main ?? ""}`, onclick: go }, title);
  const values = one.parameters.map((p) => `${p.name} ${shown(p.now, p.unit)} → ${shown(p.asked, p.unit)} ${UNITS[p.unit][0]}`.trim()).join(", ");
  const refuse = () => askAnd(t("Refuse the change of {name}?", { name: one.heliostat }), [{ name: "reason", label: t("Reason") }], t("Refuse"), (v) => api("POST", `${path}/refuse`, v), t("refuse the change"));
  return h("section", { className: "hx-why off hx-waiting" }, h("p", {}, h("b", {}, t("{name}: new parameters wait for a second engineer", { name: one.heliostat }))), h("p", {}, (one.version ? `${t("version {n} again", { n: one.version })}: ` : "") + values),
    h("p", { className: "hx-hint" }, t("Asked for by {author} at {at}: {reason}. It ends by itself at {until}.", { author: one.author, at: moment(one.at), reason: one.reason, until: moment(one.until) }),
      one.beam_rms === null ? "" : ` ${t("The beam moves by {rms} mm RMS at its aim point, at most {most} mm.", { rms: number(1e3 * one.beam_rms, 1), most: number(1e3 * one.beam_most, 1) })}`),
    buttons && me.role === "engineer" ? h("div", { className: "hx-row" }, mine ? does(t("Withdraw"), () => act(() => api("DELETE", path), t("withdraw the change")))
      : [does(t("Approve"), () => act(() => api("POST", `${path}/approve`), t("approve the change")), "main"), does(t("Refuse…"), refuse)]) : "");
}

export async function compareVersions(name) {
  const path = `heliostats/${encodeURIComponent(name)}`, known = await api("GET", `${path}/parameters`);
  const about = [...(known.version ? [{ version: known.version, note: t("in use") }] : []), ...known.earlier, { version: 0, note: t("plant file") }];
  const option = (one) => h("option", { value: one.version }, [t("version {n}", { n: one.version }), one.at ? moment(one.at) : "", one.person, one.note].filter(Boolean).join(" · "));
  const choice = (label, chosen) => { const made = h("select", { ariaLabel: label, onchange: () => load() }, about.map(option)); made.value = String(chosen); return made; };
  const first = choice(t("Earlier version"), about[1]?.version ?? 0), second = choice(t("Later version"), about[0].version);
  const body = h("div"), told = h("p", { className: "hx-told", role: "status" }), engineer = me.role === "engineer";
  const reason = h("input", { name: "reason", maxLength: 500, placeholder: t("Reason, kept with the version") });
  const waits = h("div");
  const tell = (text, bad) => { told.textContent = text; told.classList.toggle("bad", Boolean(bad)); };
  const typed = new Map(); // what was typed, by parameter, stays while versions are chosen

  const load = async () => {
    try {
      if (known.approval) waits.replaceChildren(...(await api("GET", "parameters/waiting")).filter((one) => one.heliostat === name).map((one) => waitingView(one, false)));
      const found = await api("GET", `${path}/versions?first=${first.value}&second=${second.value}`);
      const same = (r) => Math.abs(r.second - r.first) < 1e-12, typing = body.contains(document.activeElement) ? document.activeElement.name : "";
      body.replaceChildren(h("p", {}, found.beam_rms === null ? t("It does not track its aim today.") : t("The beam moves by {rms} mm RMS at its aim over today's suns, at most {most} mm.", { rms: number(1e3 * found.beam_rms, 1), most: number(1e3 * found.beam_most, 1) })),
        table([[t("Parameter"), (r) => r.name], [t("version {n}", { n: first.value }), (r) => shown(r.first, r.unit), "num"], ["σ", (r) => shown(r.first_sigma, r.unit), "num"],
          [t("version {n}", { n: second.value }), (r) => shown(r.second, r.unit), "num"], ["σ", (r) => shown(r.second_sigma, r.unit), "num"],
          [t("Change"), (r) => h("span", { className: same(r) ? "" : "warn" }, shown(r.second - r.first, r.unit)), "num"], ["", (r) => UNITS[r.unit][0]],
          ...(engineer ? [[t("New value"), (r) => h("input", { type: "number", step: "any", className: "hx-new", name: r.name, ariaLabel: t("New value of {name}", { name: r.name }), value: typed.get(r.name)?.text ?? "", oninput: ({ target }) => { if (target.value) typed.set(r.name, { text: target.value, value: Number(target.value) / UNITS[r.unit][1] }); else typed.delete(r.name); } })]] : [])], found.parameters));
      back.textContent = known.approval ? t("Ask for version {n}", { n: first.value }) : t("Bring back version {n}", { n: first.value }); back.disabled = Number(first.value) === known.version || first.value === "0";
      if (typing) body.querySelector(`[name="${CSS.escape(typing)}"]`)?.focus(); // who types meanwhile types on
    } catch (error) { tell(error.message, true); }
  };
  // The order is followed here to its end; what was typed stays after a refusal.
  const give = async (order) => {
    const sent = new Map(typed);
    try {
      if (!reason.value.trim()) throw new Error(t("give the reason: it is kept with the version and in the audit"));
      let ticket = await api("POST", "parameters", { heliostat: name, reason: reason.value, ...order });
      while (!known.approval && !ticket.finished && dialog.isConnected) { tell(ticket.text); await new Promise((wake) => setTimeout(wake, 700)); ticket = await api("GET", `commands/${encodeURIComponent(ticket.identity)}`); }
      tell(ticket.text, !ticket.good && !known.approval);
      if (ticket.good || known.approval) { for (const [key, one] of sent) if (typed.get(key) === one) typed.delete(key); reason.value = ""; await load(); }
    } catch (error) { tell(error.message, true); }
  };
  const back = h("button", { type: "button", className: "hx-button", onclick: () => give({ version: Number(first.value) }) });
  const set = h("button", { type: "button", className: "hx-button", onclick: () => (typed.size ? give({ values: Object.fromEntries([...typed].map(([key, one]) => [key, one.value])) }) : tell(t("type new values first"), true)) }, known.approval ? t("Ask for new values") : t("Store new values"));
  const dialog = h("dialog", { className: "hx-dialog wide hx-versions hx-view" }, h("h2", {}, t("Parameters of {name}, versions: {n}", { name, n: count(about.length) })),
    h("div", { className: "hx-row hx-search" }, first, "→", second), body, waits,
    engineer ? h("div", { className: "hx-row hx-search" }, reason, back, set) : "", engineer ? h("p", { className: "hx-hint" }, known.approval ? t("Nothing is written until another engineer has approved it on the heliostat's tab.") : t("The heliostat must be at stow, locked or at rest; it needs the command authority ({who}).", { who: store.mine ? t("you have it") : t("take command first") })) : "", told,
    h("div", { className: "hx-row" }, h("button", { type: "button", className: "hx-button main", onclick: () => dialog.close("") }, t("Close"))));
  await load();
  lay(dialog);
}
