// Trends of any quantity over days beside their events: drag to zoom, wheel, buttons to move, export.
import { api } from "./live.js";
import { clock, h, moment, saveCsv, several, table } from "./dom.js";
import { monthDay, plain, t } from "./words.js";

const { uPlot } = window, DAY = 86400, MOST = 6;
// Units on the screen, by those of the API.
const SCREEN = { W: ["MW", 1e-6], rad: ["mrad", 1e3] };
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
document.documentElement.classList.toggle("light", localStorage.getItem("heliotrope-theme") === "light");

const [form, tools] = [document.querySelector("form"), document.querySelector("form + div")], said = document.querySelector("[role=status]");
const charts = document.querySelector("#charts"), events = document.querySelector("#events"), synced = uPlot.sync("trends");
// A quantity is a kind of figure, and after a dot what it is of: a receiver, a state, a sensor.
const named = (quantity) => { const [kind, of] = quantity.replaceAll("_", " ").split(/\.(.*)/), text = of ? `${t(kind)}: ${kind === "state" ? t(of) : of}` : t(kind); return text[0].toUpperCase() + text.slice(1); };
const titleOf = (key) => { const [name, whose] = key.split("@"); return whose ? `${named(name)}, ${whose}` : named(name); };
const tell = (text, bad) => { said.textContent = text; said.classList.toggle("bad", Boolean(bad)); };
const asked = new URLSearchParams(location.search);
let since = Number(asked.get("since")) || 0, until = Number(asked.get("until")) || 0, marks = [], shown = [], latest = 0;
let chosen = asked.getAll("q").slice(0, MOST); // quantity, or quantity@heliostat

const known = await api("GET", "trends").catch((error) => { tell(error.message, true); return []; });
const quantity = h("select", { ariaLabel: t("Quantity") }, [[false, t("Plant")], [true, t("Heliostat")]].map(([own, title]) => h("optgroup", { label: title }, known.filter((one) => one.heliostat === own).map((one) => h("option", { value: one.name }, named(one.name))))));
const heliostat = h("input", { type: "search", placeholder: t("name of a heliostat"), ariaLabel: t("Heliostat"), maxLength: 64 });
const ofHeliostat = () => known.find((one) => one.name === quantity.value)?.heliostat;
const mark = () => { heliostat.hidden = !ofHeliostat(); };
quantity.onchange = mark; mark();
form.append(quantity, heliostat, h("button", { className: "hx-button main" }, t("Add")), h("a", { href: "/" }, t("Back to the console")));
form.onsubmit = (event) => {
  event.preventDefault();
  const name = ofHeliostat() ? `${quantity.value}@${heliostat.value.trim()}` : quantity.value;
  if (ofHeliostat() && !heliostat.value.trim()) { tell(t("write the name of a heliostat"), true); return; }
  if (chosen.length >= MOST) { tell(t("at most {n} quantities; remove one", { n: MOST }), true); return; }
  if (!chosen.includes(name)) chosen.push(name);
  load();
};
const move = (share, size = 1) => { const middle = (since + until) / 2 + share * (until - since), half = (size * (until - since)) / 2; since = middle - half; until = middle + half; load(); };
const lately = (days) => { until = 0; since = 0; load(days); };
const button = (title, go, label) => h("button", { type: "button", className: "hx-button", ariaLabel: label, title: label, onclick: go }, title);
tools.append(button(t("Day"), () => lately(1)), button(t("Week"), () => lately(7)), button(t("Month"), () => lately(30)),
  button("←", () => move(-0.5), t("Earlier")), button("→", () => move(0.5), t("Later")), button("+", () => move(0, 0.5), t("Zoom in")), button("−", () => move(0, 2), t("Zoom out")),
  button(t("Save as CSV"), () => saveCsv("trends.csv", ["time", ...shown.flatMap((one) => ["low", "mean", "high"].map((which) => `${one.key.replace("@", ", ").replaceAll("_", " ")} ${which} (${one.unit})`))],
    shown.flatMap((one, k) => one.at.map((at, i) => [new Date(1e3 * at).toISOString(), ...shown.flatMap((_, j) => (j === k ? [one.low[i], one.mean[i], one.high[i]] : ["", "", ""]))])).sort((a, b) => (a[0] < b[0] ? -1 : 1)))),
  h("span", { className: "hx-hint" }, t("Drag over a chart to zoom in; the wheel zooms; a double click shows the last day.")));

const COLOURS = { alarm: "--bad", command: "--blue", note: "--good", event: "--soft" };
// Beneath the lines. Marks that would stand closer than GAP are drawn as one, alarms before others.
const GAP = 3;
function drawMarks(plot) {
  const { ctx, bbox } = plot, taken = new Set(), alarm = (one) => Number(one.kind === "alarm");
  for (const one of marks.toSorted((a, b) => alarm(b) - alarm(a))) {
    const x = plot.valToPos(one.at, "x", true), place = Math.round(x / GAP);
    if (x < bbox.left || x > bbox.left + bbox.width || taken.has(place)) continue;
    taken.add(place);
    ctx.strokeStyle = css(COLOURS[one.kind] ?? "--soft"); ctx.lineWidth = 1; ctx.globalAlpha = 0.7;
    ctx.beginPath(); ctx.moveTo(x, bbox.top); ctx.lineTo(x, bbox.top + bbox.height); ctx.stroke(); ctx.globalAlpha = 1;
  }
}

function draw(one) {
  const box = h("section", { className: "hx-trend" }, h("div", { className: "hx-row" }, h("h2", {}, `${one.title}${one.unit ? ` (${t(one.unit)})` : ""}`), button("×", () => { chosen = chosen.filter((name) => name !== one.key); load(); }, t("Remove {name}", { name: one.title }))));
  charts.append(box);
  if (!one.at.length) { box.append(h("p", { className: "hx-hint" }, t("Nothing is kept of this time."))); return; }
  const axis = { stroke: css("--soft"), grid: { stroke: css("--line"), width: 1 }, ticks: { stroke: css("--line") } }, blue = css("--blue"), few = one.at.length < 60;
  const times = (_, splits, k, space, step) => splits.map((at) => (at % DAY === 0 ? monthDay(at) : clock(at).slice(0, step < 60 ? 8 : 5))), amount = (_, value) => (value === null || value === undefined ? "–" : plain(value));
  const plot = new uPlot({ width: box.clientWidth - 22, height: 200, cursor: { sync: { key: synced.key }, drag: { x: true, y: false, setScale: false } }, tzDate: (at) => uPlot.tzDate(new Date(at * 1e3), "UTC"),
    scales: { x: { min: since, max: until } }, axes: [{ ...axis, values: times }, { ...axis, size: 64, values: (_, splits) => splits.map(plain) }], legend: { live: true },
    series: [{ label: "UTC", value: (_, at) => moment(at) }, { label: t("mean"), value: amount, stroke: blue, width: 1.6, points: { show: few } }, { label: t("low"), value: amount, stroke: "transparent", points: { show: false } }, { label: t("high"), value: amount, stroke: "transparent", points: { show: false } }],
    bands: [{ series: [3, 2], fill: `${blue}30` }], hooks: { drawAxes: [drawMarks], setSelect: [(made) => { const { left, width } = made.select; if (width > 4) { [since, until] = [made.posToVal(left, "x"), made.posToVal(left + width, "x")]; load(); } }] } },
  [one.at, one.mean, one.low, one.high], box);
  plot.over.addEventListener("wheel", (event) => { event.preventDefault(); const at = plot.posToVal(event.offsetX, "x"), size = event.deltaY > 0 ? 1.4 : 1 / 1.4; [since, until] = [at - (at - since) * size, at + (until - at) * size]; soon(); }, { passive: false });
  plot.over.addEventListener("dblclick", () => lately(1));
  plot.root.setAttribute("role", "img"); plot.root.setAttribute("aria-label", one.title);
}

const unfolded = new Set();
let waits = 0;
const soon = () => { clearTimeout(waits); waits = setTimeout(() => load(), 150); };
// The last asked for wins: an earlier answer that comes late is left.
async function load(days = 1) {
  const mine = ++latest;
  try {
    tell("");
    if (!until) { until = (await api("GET", "sun").then((now) => Date.parse(now.at) / 1e3)); since = until - days * DAY; }
    const time = `since=${since.toFixed(0)}&until=${Math.max(until, since + 60).toFixed(0)}`;
    const found = await Promise.all(chosen.map(async (key) => {
      const [name, whose = ""] = key.split("@"), one = await api("GET", `trend?${new URLSearchParams({ quantity: name, heliostat: whose })}&${time}`), [unit, size] = SCREEN[one.unit] ?? [one.unit, 1];
      const scaled = (values) => values.map((v) => (v === null ? null : v * size));
      return { key, title: titleOf(key), unit, at: one.at, low: scaled(one.low), mean: scaled(one.mean), high: scaled(one.high) };
    }));
    const whose = chosen.map((key) => key.split("@")[1]).filter(Boolean);
    const entries = await api("GET", `journal?${time}&limit=500&but=automatic+control${whose.length === 1 && chosen.length === 1 ? `&heliostat=${encodeURIComponent(whose[0])}` : ""}`);
    if (mine !== latest) return;
    shown = found; marks = entries;
    history.replaceState(null, "", `?${new URLSearchParams([...chosen.map((key) => ["q", key]), ["since", since.toFixed(0)], ["until", until.toFixed(0)]])}`);
    charts.replaceChildren(...(chosen.length ? [] : [h("p", { className: "hx-hint" }, t("Choose a quantity and press Add."))]));
    found.forEach(draw);
    events.replaceChildren(entries.length ? table([[t("Time"), (r) => moment(r.at)], [t("Kind"), (r) => t(r.kind)], [t("What"), (r) => (r.kind === "event" ? t(r.what) : r.what)], ["", (r) => (r.heliostats.length ? [several(r.heliostats, `${r.at}${r.what}`, unfolded), " ", r.text] : r.text)]], entries.slice(0, 100)) : h("p", { className: "hx-hint" }, t("None.")));
  } catch (error) { if (mine === latest) tell(error.message, true); }
}
if (!chosen.length && known.length) chosen = [known.find((one) => one.name.startsWith("power."))?.name ?? known[0].name];
if (chosen.length) { [quantity.value] = chosen[0].split("@"); mark(); }
new ResizeObserver(() => { if (charts.clientWidth !== charts.dataset.wide) { charts.dataset.wide = charts.clientWidth; if (shown.length) { charts.replaceChildren(); shown.forEach(draw); } } }).observe(document.body);
await load();
