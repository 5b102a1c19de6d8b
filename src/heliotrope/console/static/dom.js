// Building blocks of the page. Text is always inserted as text, never as markup.
import { store } from "./live.js";
import { day, fixed, plain, t, whole } from "./words.js";

export function h(tag, given = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(given)) {
    if (value === undefined || value === false) continue;
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name in made && name !== "list") made[name] = value;
    else made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return made;
}

const known = (value) => value !== null && value !== undefined && Number.isFinite(value);
export const number = (value, digits = 2) => (known(value) ? fixed(value, digits) : "–");
export const mrad = (value, digits = 2) => (known(value) ? fixed(1e3 * value, digits) : "–");
export const degrees = (value, digits = 2) => (known(value) ? fixed((value * 180) / Math.PI, digits) : "–");
export const count = (value) => (known(value) ? whole(value) : "–");
export const clock = (at) => (known(at) && at > 0 ? new Date(1e3 * at).toISOString().slice(11, 19) : "–");
// The same in the browser's time zone, "" where that is UTC: always beside UTC, never instead of it.
export function local(at) {
  const date = new Date(1e3 * at), two = (value) => String(value).padStart(2, "0");
  return known(at) && date.getTimezoneOffset() ? `${two(date.getHours())}:${two(date.getMinutes())}` : "";
}
// With its day, unless that is the plant's present day, and with the local time in brackets.
export function moment(at) {
  if (!known(at) || at <= 0) return "–";
  const text = new Date(1e3 * at).toISOString(), today = store.head?.at.slice(0, 10), here = local(at);
  return `${text.slice(0, 10) === today ? "" : `${day(at)} `}${text.slice(11, 19)}${here && ` (${here})`}`;
}
export function span(seconds) {
  if (!known(seconds)) return t("never");
  if (seconds < 120) return `${Math.max(0, seconds).toFixed(0)} s`;
  if (seconds < 7200) return `${(seconds / 60).toFixed(0)} min`;
  return seconds < 172800 ? `${fixed(seconds / 3600, 1)} h` : `${fixed(seconds / 86400, 1)} d`;
}

export function table(columns, rows, act) {
  const head = h("tr", {}, columns.map(([title, , kind]) => h("th", { className: kind ?? "" }, title)));
  const body = rows.map((row) => h("tr", act ? { className: "can", tabIndex: 0, onclick: () => act(row),
    onkeydown: (event) => { if (event.key === "Enter") act(row); } } : {},
    columns.map(([, show, kind]) => { const cell = show(row); return h("td", { className: kind ?? "" }, cell ?? ""); })));
  return h("div", { className: "hx-scroll" }, h("table", { className: "hx-table" }, h("thead", {}, head), h("tbody", {}, body)));
}

// The first names of many, all of them on a click; a list that is drawn anew stays as it was. Of `all` there may be more than the names: `rest` then gets them.
const FEW = 3;
export function several(names, key, shown, all = names.length, rest = null) {
  if (names.length <= FEW + 1) return h("b", {}, names.join(", "));
  const more = all > names.length ? `, … (${count(all)})` : "", others = h("span", {}, names.slice(FEW).join(", ") + more);
  const box = h("details", { className: "hx-several", open: shown.has(key) },
    h("summary", { title: names.join(", ") + more }, h("b", {}, names.slice(0, FEW).join(", ")), " ", t("and {n} more", { n: count(all - FEW) })), others);
  box.ontoggle = async () => {
    if (!box.open) { shown.delete(key); return; }
    shown.add(key);
    // Those that cannot be had stay a number.
    if (more && rest) others.textContent = await rest().then((found) => found.slice(FEW).join(", "), () => others.textContent);
  };
  return box;
}

// Saves rows as a file of comma-separated values.
export function saveCsv(name, titles, rows) {
  const cell = (value) => (/[",\n]/.test(String(value ?? "")) ? `"${String(value).replaceAll('"', '""')}"` : String(value ?? ""));
  const text = [titles, ...rows].map((row) => row.map(cell).join(",")).join("\n");
  const link = h("a", { href: URL.createObjectURL(new Blob([`${text}\n`], { type: "text/csv" })), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

export function facts(pairs) {
  return h("dl", { className: "hx-facts" }, pairs.filter(Boolean).map(([name, value, extra]) =>
    h("div", { className: extra ?? "" }, h("dt", {}, name), h("dd", {}, value))));
}

// Where the keyboard's focus was last: the places of its ancestors among their siblings, so that it is found again in what is drawn anew.
let focused = { element: null, path: [] };
document.addEventListener("focusin", ({ target }) => {
  const path = [];
  for (let one = target; one !== document.body && one.parentElement; one = one.parentElement) path.unshift([...one.parentElement.children].indexOf(one));
  focused = { element: target, path };
});
function keepFocus() {
  const { element: old, path } = focused;
  if (!old || old.isConnected || document.activeElement !== document.body) return;
  const now = path.reduce((one, place) => one?.children[place], document.body);
  if (now?.tagName === old.tagName && now.textContent === old.textContent) now.focus({ preventScroll: true });
}

// Calls `load` now, whenever `key()` changes, and every `every` seconds; never twice at once.
export function refreshed(load, { key = () => "", every = Infinity } = {}) {
  let busy = false, last = "", at = -Infinity, over = false;
  const look = async () => {
    const now = performance.now(), present = String(key());
    if (busy || over || document.hidden || (present === last && now - at < 1e3 * every)) return;
    busy = true; last = present; at = now;
    try { await load(); keepFocus(); } catch (error) { store.emit("said", { text: error.message, bad: true }); }
    finally { busy = false; }
  };
  const off = store.on("frame", look);
  look();
  return () => { over = true; off(); };
}

// Opens a dialog over the page. A modal of the browser would lie over EMERGENCY and disable it; here the rest of the
// page is made inert, so that only the dialog and EMERGENCY can be reached.
export function lay(dialog) {
  const before = document.activeElement;
  const rest = [...document.body.children].filter((part) => part.id !== "emergency-box" && !part.inert);
  rest.forEach((part) => { part.inert = true; });
  const hear = (event) => { if (event.key === "Escape" && dialog === [...document.querySelectorAll("dialog")].at(-1)) { event.stopPropagation(); dialog.close(""); } };
  dialog.addEventListener("close", () => {
    document.removeEventListener("keydown", hear, true);
    dialog.remove();
    rest.forEach((part) => { part.inert = false; });
    before?.focus?.();
  });
  document.addEventListener("keydown", hear, true);
  document.body.append(dialog);
  dialog.show();
}

// Asks in a dialog; null: cancelled. An option is a value, or a value and its text. With `go` the dialog stays after an error, with what was typed, until `go` has succeeded.
export function ask(title, fields, confirm, go = async () => {}) {
  return new Promise((resolve) => {
    const told = h("p", { className: "hx-told bad", role: "alert", hidden: true }), given = () => Object.fromEntries(fields.map((field, i) => [field.name, inputs[i].value]));
    let busy = false;
    const submit = async (event) => {
      event.preventDefault();
      if (busy) return;
      busy = true;
      try { await go(given()); dialog.close("yes"); } catch (error) { told.textContent = error.message; told.hidden = false; } finally { busy = false; }
    };
    const inputs = fields.map((field) => {
      if (field.options) return h("select", { name: field.name }, field.options.map((o) => [o].flat()).map(([value, text = value]) => h("option", { value }, text)));
      return h("input", { name: field.name, type: field.type ?? "text", value: field.value ?? "", step: "any", required: field.required ?? true });
    });
    const dialog = h("dialog", { className: "hx-dialog" }, h("form", { onsubmit: submit },
      h("h2", {}, title), fields.map((field, i) => h("label", {}, field.label, inputs[i])), told,
      h("div", { className: "hx-row" },
        h("button", { type: "button", className: "hx-button", onclick: () => dialog.close("") }, t("Cancel")),
        h("button", { type: "submit", value: "yes", className: "hx-button main" }, confirm))));
    dialog.addEventListener("close", () => {
      resolve(dialog.returnValue === "yes" ? given() : null);
    });
    lay(dialog);
  });
}

// A chart of lines over time with a logarithmic scale in mrad.
export function chart(canvas, series, night) {
  const ratio = Math.min(2, window.devicePixelRatio || 1), wide = canvas.clientWidth, high = canvas.clientHeight;
  canvas.width = wide * ratio; canvas.height = high * ratio;
  const c = canvas.getContext("2d");
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.clearRect(0, 0, wide, high);
  const points = series.flatMap((line) => line.points).filter(([, v]) => v > 0);
  c.font = "11px system-ui, sans-serif"; c.fillStyle = night ? "#aab4bf" : "#57606a";
  if (!points.length) { c.fillText(t("no measurement has finished yet"), 12, high / 2); return; }
  const times = points.map(([t]) => t), values = points.map(([, v]) => v);
  const first = Math.min(...times), last = Math.max(...times, first + 60);
  const low = Math.log10(Math.min(...values, 0.1)) - 0.1, top = Math.log10(Math.max(...values, 20)) + 0.05;
  const x = (t) => 40 + ((wide - 52) * (t - first)) / (last - first);
  const y = (v) => high - 22 - ((high - 32) * (Math.log10(v) - low)) / (top - low);
  c.strokeStyle = night ? "#2b333c" : "#dfe2e6"; c.lineWidth = 1; c.textAlign = "right";
  for (const v of [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50]) {
    if (Math.log10(v) < low || Math.log10(v) > top) continue;
    c.beginPath(); c.moveTo(40, y(v)); c.lineTo(wide - 12, y(v)); c.stroke();
    c.fillText(plain(v), 34, y(v) + 4);
  }
  c.textAlign = "left"; c.fillText(clock(first), 40, high - 6);
  c.textAlign = "right"; c.fillText(clock(last), wide - 12, high - 6);
  for (const { points: line, colour, dash, dots } of series) {
    c.strokeStyle = c.fillStyle = colour; c.lineWidth = 2; c.setLineDash(dash ?? []);
    c.beginPath();
    line.filter(([, v]) => v > 0).forEach(([t, v], i) => {
      if (dots) c.fillRect(x(t) - 2, y(v) - 2, 4, 4);
      else if (i) c.lineTo(x(t), y(v)); else c.moveTo(x(t), y(v));
    });
    if (!dots) c.stroke();
  }
  c.setLineDash([]);
}
