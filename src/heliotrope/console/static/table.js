// The table of heliostats: any column, sorted and filtered; select from it, save selections and CSV.
// Only the rows in view are in the page, so that 100,000 scroll as ten do.
import { rowsWhere, store } from "./live.js";
import { ask, count, h, mrad, number as shown, saveCsv, span } from "./dom.js";
import { say } from "./orders.js";
import { english, t, word } from "./words.js";

const HIGH = 27, SAVED = "heliotrope-selections";
// Title, text of a row, what it is sorted by, whether it is a number.
const COLUMNS = [
  [word("Name"), (i) => store.field.names[i], (i) => store.field.names[i]],
  [word("State"), (i) => t(store.stateName(i)), (i) => store.stateName(i)],
  [word("On"), (i) => { const on = store.head?.surfaces?.[store.aim[i]] ?? ""; return on === "elsewhere" ? t("elsewhere") : on; }, (i) => store.head?.surfaces?.[store.aim[i]] ?? ""],
  [word("Predicted error (mrad)"), (i) => mrad(store.error[i]), (i) => store.error[i], true],
  [word("Measured error (mrad)"), (i) => mrad(store.measured[i]), (i) => store.measured[i], true],
  [word("Calibrated"), (i) => (Number.isNaN(store.ageOf(i)) ? t("never") : span(store.ageOf(i))), (i) => store.ageOf(i), true],
  [word("Sightings"), (i) => String(store.sightings[i]), (i) => store.sightings[i], true],
  [word("Fault"), (i) => (store.fault[i] ? String(store.fault[i]) : ""), (i) => store.fault[i], true],
  [word("Service"), (i) => (store.out[i] ? t("out") : ""), (i) => store.out[i], true],
  [word("Cluster"), (i) => store.field.clusters[store.field.cluster[i]], (i) => store.field.cluster[i], true],
  [word("East (m)"), (i) => shown(store.field.positions[i][0], 1), (i) => store.field.positions[i][0], true],
  [word("North (m)"), (i) => shown(store.field.positions[i][1], 1), (i) => store.field.positions[i][1], true],
];

const saved = () => JSON.parse(localStorage.getItem(SAVED) ?? "{}");

export function heliostats(box) {
  let by = 3, down = true, rows = [], last = -1;
  const which = h("input", { type: "search", className: "hx-query", placeholder: t("all; or state = TRACKING and error > 1"), ariaLabel: t("Rows"), title: t("Names or conditions, as above the map; empty: all") });
  // How many of them, from the top: by touch and by keyboard there is no Shift-click.
  const most = h("select", { ariaLabel: t("Number of rows"), onchange: () => sorted() }, h("option", { value: Infinity }, t("all rows")), [10, 20, 50, 100].map((n) => h("option", { value: n }, t("top {n}", { n }))));
  const number = h("span", { className: "hx-hint" }), head = h("div", { className: "hx-grid-row head", role: "row" }), body = h("div", { className: "hx-grid-body" });
  const grid = h("div", { className: "hx-grid", role: "grid", tabIndex: 0 }, head, body);
  const lines = new Map(); // the rows in the page, by their places
  const titles = COLUMNS.map(([, , , right], k) => h("button", { type: "button", role: "columnheader", className: right ? "num" : "", onclick: () => { down = k === by ? !down : Boolean(right); by = k; sorted(); } }));
  head.append(...titles);
  const kept = h("select", { ariaLabel: t("Saved selections"), onchange: () => take(kept.value) });

  const sorted = () => {
    try { rows = which.value.trim() ? rowsWhere(which.value) : [...store.field.names.keys()]; } catch (error) { say(error.message, true); rows = []; }
    const get = COLUMNS[by][2], sign = down ? -1 : 1, key = new Map(rows.map((i) => [i, get(i)])), none = (v) => typeof v === "number" && Number.isNaN(v);
    // Those without a value come last in both directions.
    rows.sort((a, b) => { const x = key.get(a), y = key.get(b); return none(x) || none(y) ? none(x) - none(y) : sign * (x < y ? -1 : x > y ? 1 : 0); });
    rows.splice(Number(most.value));
    number.textContent = t("{n} of {all}", { n: count(rows.length), all: count(store.field.names.length) });
    titles.forEach((button, k) => {
      button.ariaSort = k === by ? (down ? "descending" : "ascending") : "none";
      button.textContent = t(COLUMNS[k][0]) + (k === by ? (down ? " ↓" : " ↑") : "");
    });
    body.style.height = `${rows.length * HIGH}px`;
    draw();
  };
  const fill = (line, place) => {
    const row = rows[place];
    line.ariaSelected = store.selection.has(row);
    COLUMNS.forEach(([, text], k) => { const cell = line.children[k], now = text(row); if (cell.textContent !== now) cell.textContent = now; });
  };
  const lineOf = (place) => {
    const line = h("div", { className: "hx-grid-row", role: "row", onclick: (event) => pick(place, event) },
      COLUMNS.map(([, , , right]) => h("span", { role: "gridcell", className: right ? "num" : "" })));
    line.style.top = `${place * HIGH}px`;
    fill(line, place);
    return line;
  };
  // Makes only the rows that come into view: making all of them takes longer than a frame.
  const slide = () => {
    const first = Math.max(0, Math.floor(grid.scrollTop / HIGH) - 5), end = Math.min(rows.length, first + Math.ceil((grid.clientHeight || 600) / HIGH) + 10);
    for (const [place, line] of lines) if (place < first || place >= end) { line.remove(); lines.delete(place); }
    const least = Math.min(...lines.keys()), above = [], below = [];
    for (let place = first; place < end; place++) if (!lines.has(place)) {
      lines.set(place, lineOf(place));
      (place < least ? above : below).push(lines.get(place));
    }
    body.prepend(...above); body.append(...below);
  };
  // The rows stay, with new texts: one that is made anew under a press swallows its click.
  const draw = () => { for (const [place, line] of lines) if (place < rows.length) fill(line, place); slide(); };
  // A click selects one; with Ctrl one more or one less, with Shift all up to it.
  const pick = (at, event) => {
    const row = rows[at], chosen = event.ctrlKey || event.metaKey || event.shiftKey ? new Set(store.selection) : new Set();
    const from = rows.indexOf(last);
    if (event.shiftKey && from >= 0) for (const one of rows.slice(Math.min(from, at), Math.max(from, at) + 1)) chosen.add(one);
    else if (chosen.has(row)) chosen.delete(row);
    else chosen.add(row);
    if (!event.shiftKey) last = row;
    store.select(chosen, chosen.size === 1 ? [...chosen][0] : store.focus);
  };
  const list = () => kept.replaceChildren(h("option", { value: "" }, t("Saved selections…")), ...Object.entries(saved()).map(([name, names]) => h("option", { value: name }, `${name} (${count(names.length)})`)));
  const take = (name) => {
    const known = (saved()[name] ?? []).map((one) => store.index.get(one)).filter((row) => row !== undefined);
    if (name) { store.select(known, known.length === 1 ? known[0] : -1); say(t("{name}: {n} heliostats are selected", { name, n: count(known.length) })); }
    kept.value = "";
  };
  const keep = async () => {
    const names = store.selected(); // as the question counts them
    if (!names.length) { say(t("Save: nothing is selected"), true); return; }
    const given = await ask(t("Save these {n} heliostats under a name? It stays in this browser; an earlier selection of that name is replaced.", { n: count(names.length) }), [{ name: "name", label: t("Name") }], t("Save"));
    if (!given) return;
    localStorage.setItem(SAVED, JSON.stringify({ ...saved(), [given.name]: names }));
    list();
  };
  const csv = () => saveCsv("heliostats.csv", COLUMNS.map(([title]) => title), english(() => rows.map((row) => COLUMNS.map(([, text]) => text(row)))));
  const button = (title, go, main) => h("button", { className: `hx-button ${main ?? ""}`, onclick: go }, title);
  which.addEventListener("keydown", (event) => { if (event.key === "Enter") sorted(); event.stopPropagation(); });
  which.addEventListener("search", sorted);
  grid.addEventListener("scroll", slide);
  box.append(h("div", { className: "hx-row hx-search" }, which, most, button(t("Show"), sorted, "main"), number), h("div", { className: "hx-row hx-search" },
    button(t("Select these"), () => store.select(rows, rows.length === 1 ? rows[0] : -1)), button(t("Show the selection"), () => { which.value = store.selected().join(" "); sorted(); }), button(t("Save selection…"), keep), kept, button(t("Save as CSV"), csv)), grid);
  list(); sorted();
  let at = 0; // values change with each frame, their order every five seconds, but not under a pointer that chooses a row
  const off = [store.on("selection", draw), store.on("frame", () => (performance.now() - at > 5000 && !body.matches(":hover") ? (at = performance.now(), sorted()) : draw()))];
  return () => off.forEach((end) => end());
}
