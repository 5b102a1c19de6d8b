// The report of a shift, for the screen and for paper.
import { api } from "./live.js";
import { count, facts, h, moment, mrad, number, table } from "./dom.js";
import { t } from "./words.js";

const SVG = "http://www.w3.org/2000/svg", HOUR = 3600, DAY = 86400;
const hours = (seconds) => `${number(seconds / HOUR, 1)} h`;
const percent = (share) => (share === null ? "–" : `${number(100 * share, 1)} %`);

function svg(tag, given) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(given)) made.setAttribute(name, value);
  return made;
}

// The power over the time, drawn as lines of a vector picture: it prints sharply.
function powerCurve(found) {
  const wide = 720, high = 150, points = found.power.filter(([, p]) => p !== null), top = Math.max(1, ...points.map(([, p]) => p)) * 1.08;
  const x = (at) => 46 + ((wide - 54) * (at - found.since)) / (found.until - found.since), y = (p) => high - 20 - ((high - 28) * p) / top;
  const box = svg("svg", { viewBox: `0 0 ${wide} ${high}`, class: "hx-curve", role: "img", "aria-label": t("Power into the receivers, predicted (MW)") });
  const text = (said, at, up, anchor) => { const one = svg("text", { x: at, y: up, "text-anchor": anchor }); one.textContent = said; box.append(one); };
  for (const share of [0, 0.5, 1]) { const at = y(share * top); box.append(svg("line", { x1: 46, x2: wide - 8, y1: at, y2: at })); text(number((share * top) / 1e6, 2), 42, at + 4, "end"); }
  box.append(svg("polyline", { points: points.map(([at, p]) => `${x(at).toFixed(1)},${y(p).toFixed(1)}`).join(" ") }));
  text(moment(found.since), 46, high - 4, "start"); text(moment(found.until), wide - 8, high - 4, "end");
  return h("figure", { className: "hx-figure" }, h("figcaption", { className: "hx-hint" }, t("Power into the receivers, predicted (MW)")), box);
}

function sheet(found) {
  const none = h("p", { className: "hx-hint" }, t("None.")), list = (rows, columns) => (rows.length ? table(columns, rows) : none.cloneNode(true));
  const [begin, end] = [found.errors[0], found.errors.at(-1)];
  return [
    h("h1", {}, t("Shift report: {plant}", { plant: found.plant })),
    h("p", {}, `${moment(found.since)} – ${moment(found.until)} UTC`, h("span", { className: "hx-hint" }, ` · ${t("created {at} UTC, with data for {hours} of this period", { at: moment(found.made), hours: hours(found.recorded) })}`)),
    h("h2", {}, t("Production")),
    facts([...found.production.flatMap((one) => [[t("Energy into {name}, predicted", { name: one.receiver }), `${number(one.energy / 3.6e9, 3)} MWh`], [t("Peak power"), `${number(one.peak / 1e6, 2)} MW, ${moment(one.peak_at)}`]]),
      [t("Direct sunlight"), found.sunshine === null ? t("no reading") : `${number(found.sunshine / 3.6e6, 2)} kWh/m²`], [t("Sun above the horizon"), hours(found.daylight)]]),
    found.power.length > 1 ? powerCurve(found) : "",
    h("h2", {}, t("Availability")),
    facts([[t("Heliostats available in daylight"), percent(found.availability)], ...Object.entries(found.lacks).map(([why, s]) => [t(why), s === null ? "–" : t("{hours} heliostat-hours", { hours: number(s / HOUR, 1) })])]),
    h("h2", {}, t("Calibrations")),
    facts(Object.entries(found.outcomes).map(([outcome, n]) => [t(outcome.replaceAll("_", " ")), count(n)])),
    begin ? table([["", (r) => moment(r.at)], [t("Calibrated"), (r) => count(r.calibrated), "num"], [t("Median error (mrad)"), (r) => mrad(r.median), "num"], [t("90th percentile (mrad)"), (r) => mrad(r.percentile_90), "num"]], [begin, end]) : "",
    h("h3", {}, t("Visits without a new calibration ({n})", { n: count(found.failed.length) })),
    list(found.failed.slice(0, 40), [[t("Time"), (r) => moment(r.finished)], [t("Heliostat"), (r) => r.heliostat], [t("Target"), (r) => r.target], ["", (r) => r.text]]),
    h("h2", {}, t("Alarms ({n})", { n: count(found.alarms.length) })),
    list(found.alarms, [[t("Raised"), (r) => moment(r.raised)], [t("Over"), (r) => (r.cleared ? moment(r.cleared) : t("active"))], [t("What"), (r) => `${r.condition} ${r.subject}`], ["", (r) => r.text], [t("Acknowledged"), (r) => (r.acknowledged ? `${r.acknowledged_by}, ${moment(r.acknowledged)}` : t("no"))]]),
    h("h2", {}, t("Out of service now ({n})", { n: count(found.locks.length) })),
    list(found.locks, [[t("Locked"), (r) => (r.kind === "heliostat" ? r.name : `${t(r.kind)} ${r.name}`)], [t("Since"), (r) => moment(r.since)], [t("Owner"), (r) => r.who], [t("Why"), (r) => r.reason]]),
    h("h2", {}, t("Work done ({n})", { n: count(found.work.length) })),
    list(found.work, [[t("Time"), (r) => moment(r.at)], ["", (r) => r.text]]),
    h("h2", {}, t("Notes ({n})", { n: count(found.notes.length) })),
    list(found.notes, [[t("Time"), (r) => moment(r.at)], ["", (r) => r.text]]),
  ];
}

// Times are typed in UTC.
const typed = (at) => new Date(1e3 * at).toISOString().slice(0, 16), read = (box) => (box.value ? Date.parse(`${box.value}Z`) / 1e3 : 0);
const form = document.querySelector("form"), said = document.querySelector("[role=status]"), sheetBox = document.querySelector("article");
const since = h("input", { type: "datetime-local" }), until = h("input", { type: "datetime-local" });
let now = Date.now() / 1e3; // the plant's, once it is known

async function show(from, to) {
  said.textContent = "";
  try {
    const found = await api("GET", `report?since=${from}&until=${to}`);
    now = Math.max(now, found.made); if (found.made < now - DAY) now = found.made;
    since.value = typed(found.since); until.value = typed(found.until);
    history.replaceState(null, "", `?since=${found.since}&until=${found.until}`);
    sheetBox.replaceChildren(...sheet(found));
  } catch (error) { said.textContent = error.message; said.classList.add("bad"); }
}
const midnight = () => DAY * Math.floor(now / DAY), button = (title, go) => h("button", { type: "button", className: "hx-button", onclick: go }, title);
form.append(h("label", { className: "hx-field" }, t("From (UTC)"), since), h("label", { className: "hx-field" }, t("To (UTC)"), until), h("button", { className: "hx-button main" }, t("Show")),
  button(t("Last 8 hours"), () => show(0, 0)), button(t("Today"), () => show(midnight(), 0)), button(t("Yesterday"), () => show(midnight() - DAY, midnight())),
  button(t("Print"), () => print()), h("a", { href: "/" }, t("Back to the console")));
form.onsubmit = (event) => { event.preventDefault(); show(read(since), read(until)); };
document.documentElement.classList.toggle("light", localStorage.getItem("heliotrope-theme") === "light");
const asked = new URLSearchParams(location.search);
await show(Number(asked.get("since")) || 0, Number(asked.get("until")) || 0);

