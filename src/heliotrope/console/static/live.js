// The page's data: the live stream, decoded into one table, and access to the API.
// Everything that is shown comes from here; nothing is drawn here.
import { t, word } from "./words.js";

export const STATES = [word("UNCONFIGURED"), word("STOWED"), word("STOWING"), word("APPROACHING"), word("IDLE"), word("TRACKING"),
  word("DEFOCUSED"), word("LOCKED"), word("SEARCHING"), word("FAULT")];
export const STALE = 255;
const ROW = 24; // bytes of a row; see docs/reference/api-http.md
const LATE = 3000; // ms after which the last data is no longer shown as live

const meta = (name) => document.querySelector(`meta[name="${name}"]`)?.content ?? "";
export const me = { name: meta("heliotrope-person"), role: meta("heliotrope-role") };

class Store extends EventTarget {
  field = null; // names, positions, clusters: what does not change
  head = null; // the last message's header
  received = 0; // when it came, ms
  selection = new Set(); // rows
  focus = -1; // the row that is looked at
  live = false;
  early = []; // messages that came before the field
  confirm = async () => false; // asks the person for their password; whether they gave it

  emit(name, detail) { this.dispatchEvent(new CustomEvent(name, { detail })); }

  on(name, act) {
    const hear = (event) => act(event.detail);
    this.addEventListener(name, hear);
    return () => this.removeEventListener(name, hear);
  }

  async start() {
    this.connect(); // messages that come before the field are kept in `early`
    while (!this.field) {
      try { this.field = await api("GET", "field"); } catch (error) {
        this.emit("said", { text: t("no data from the plant, asking again: {error}", { error: error.message }), bad: true });
        await new Promise((wake) => setTimeout(wake, 1000));
      }
    }
    const n = this.field.names.length;
    this.index = new Map(this.field.names.map((name, row) => [name, row]));
    this.state = new Uint8Array(n).fill(STALE);
    this.fault = new Uint8Array(n);
    this.flags = new Uint16Array(n);
    this.aim = new Uint8Array(n).fill(STALE);
    this.out = new Uint8Array(n); // of service
    this.sightings = new Uint16Array(n);
    this.calibrated = new Uint32Array(n);
    this.error = new Float32Array(n).fill(NaN);
    this.measured = new Float32Array(n).fill(NaN);
    this.emit("field");
    this.emit("said", { text: "" });
    this.early.forEach((buffer) => this.take(buffer));
    this.early = [];
    setInterval(() => this.watch(), 500);
  }

  connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/api/v1/live`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = (event) => this.take(event.data);
    socket.onclose = (event) => {
      if (event.code === 4401) location.assign("/login");
      else setTimeout(() => this.connect(), 1000);
    };
    this.socket = socket;
  }

  watch() {
    const live = performance.now() - this.received < LATE && this.received > 0;
    if (live !== this.live) { this.live = live; this.emit("live", live); }
    // A socket may be dead without knowing it.
    if (!live && this.received && performance.now() - this.received > 10000) {
      this.received = performance.now() - LATE;
      this.socket.close();
    }
  }

  take(buffer) {
    if (!this.state) { this.early.push(buffer); return; }
    const view = new DataView(buffer);
    const length = view.getUint32(4, true);
    this.head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length)));
    this.received = performance.now();
    for (let at = 8 + length; at + ROW <= buffer.byteLength; at += ROW) {
      const row = view.getUint32(at, true);
      this.error[row] = view.getFloat32(at + 4, true);
      this.measured[row] = view.getFloat32(at + 8, true);
      this.calibrated[row] = view.getUint32(at + 12, true);
      this.sightings[row] = view.getUint16(at + 16, true);
      this.flags[row] = view.getUint16(at + 18, true);
      this.state[row] = view.getUint8(at + 20);
      this.fault[row] = view.getUint8(at + 21);
      this.aim[row] = view.getUint8(at + 22);
      this.out[row] = view.getUint8(at + 23);
    }
    this.watch();
    this.emit("frame", this.head);
  }

  stateOf(row) { return this.live ? this.state[row] : STALE; }
  stateName(row) { const s = this.stateOf(row); return s === STALE ? word("stale") : STATES[s]; }
  ageOf(row) { // of the calibration, s; NaN: never
    return this.calibrated[row] && this.head ? this.head.utc - this.calibrated[row] : NaN;
  }

  select(rows, focus) {
    this.selection = new Set(rows);
    if (focus !== undefined) this.focus = focus;
    else if (this.selection.size === 1) this.focus = [...this.selection][0];
    this.emit("selection");
  }
  selected() { return [...this.selection].map((row) => this.field.names[row]); }
}

export const store = new Store();

export class ApiError extends Error {
  constructor(status, text) { super(text); this.status = status; }
}

// Ends with the press under way, within a second: what is drawn anew under a finger or a pointer swallows its click.
let press = Promise.resolve();
addEventListener("pointerdown", () => {
  press = new Promise((end) => {
    for (const name of ["pointerup", "pointercancel"]) addEventListener(name, () => setTimeout(end), { once: true, capture: true });
    setTimeout(end, 1000);
  });
}, true);

// How long a reading may take, ms.
const LONGEST = 30e3;
export async function api(method, path, body) {
  const options = { method, headers: { "X-CSRF-Token": meta("heliotrope-csrf") }, credentials: "same-origin" };
  if (body !== undefined) {
    options.body = JSON.stringify(body);
    options.headers["Content-Type"] = "application/json";
  }
  // A reading that never ends would leave its panel as it is for ever; an order waits as long as the plant takes.
  if (method === "GET") options.signal = AbortSignal.timeout(LONGEST);
  const answer = await fetch(`/api/v1/${path}`, options).catch(() => { throw new ApiError(0, t("the console does not answer")); });
  // The page was left alone for long: the person confirms, and the order goes again.
  if (answer.status === 423 && await store.confirm()) return api(method, path, body);
  if (answer.status === 401) { location.assign("/login"); throw new ApiError(401, t("signed out")); }
  const data = answer.status === 204 ? null : await answer.json().catch(() => { throw new ApiError(answer.status, t("the console answered with error {status}", { status: answer.status })); });
  if (!answer.ok) {
    const detail = typeof data.detail === "string" ? data.detail : JSON.stringify(data.detail);
    throw new ApiError(answer.status, detail);
  }
  if (method === "GET") await press;
  return data;
}

// The query language: FIELD OP VALUE [and|or ...]; "and" binds tighter.
const FIELDS = {
  state: (row) => store.stateName(row).toUpperCase(),
  name: (row) => store.field.names[row].toUpperCase(),
  cluster: (row) => store.field.clusters[store.field.cluster[row]].toUpperCase(),
  error: (row) => 1e3 * store.error[row],
  measured: (row) => 1e3 * store.measured[row],
  age: (row) => store.ageOf(row) / 3600,
  sightings: (row) => store.sightings[row],
  fault: (row) => store.fault[row],
  on: (row) => (store.head?.surfaces?.[store.aim[row]] ?? "").toUpperCase(),
  service: (row) => (store.out[row] ? "OUT" : "IN"),
  east: (row) => store.field.positions[row][0],
  north: (row) => store.field.positions[row][1],
};
const OPERATORS = {
  "=": (a, b) => a === b, "!=": (a, b) => a !== b, "<": (a, b) => a < b, ">": (a, b) => a > b,
  "<=": (a, b) => a <= b, ">=": (a, b) => a >= b,
  "~": (a, b) => new RegExp(`^${String(b).replace(/[.+^${}()|[\]\\]/g, "\\$&").replace(/\*/g, ".*").replace(/\?/g, ".")}$`).test(a),
};

// A state by its English name, or by the one that the page shows.
const stateSaid = (said) => [...STATES, "stale"].find((one) => t(one).toUpperCase() === said)?.toUpperCase() ?? said;

export function parseQuery(text) {
  const term = /^\s*([a-z]+)\s*(<=|>=|!=|=|<|>|~)\s*("[^"]*"|[^\s"]+)\s*/i;
  const either = [[]];
  let rest = text;
  for (;;) {
    const match = term.exec(rest);
    if (!match) throw new Error(t('cannot read "{text}"; write: state = TRACKING and error > 1', { text: rest.trim() || text }));
    const [whole, field, sign, raw] = match;
    const get = FIELDS[field.toLowerCase()];
    if (!get) throw new Error(t('no field "{field}"; there are {fields}', { field, fields: Object.keys(FIELDS).join(", ") }));
    const said = raw.replace(/"/g, "").toUpperCase(), name = get === FIELDS.state ? stateSaid(said) : said;
    const number = typeof get(0) === "number";
    const value = number && sign !== "~" ? (name === "NEVER" ? NaN : Number(name)) : name;
    if (number && name !== "NEVER" && Number.isNaN(value)) throw new Error(t('{field}: "{value}" is not a number', { field, value: raw }));
    either.at(-1).push(Number.isNaN(value)
      ? (row) => Number.isNaN(get(row)) === (sign === "=") : (row) => OPERATORS[sign](get(row), value));
    rest = rest.slice(whole.length);
    const joint = /^(and|or)\b/i.exec(rest);
    if (!joint) break;
    if (joint[1].toLowerCase() === "or") either.push([]);
    rest = rest.slice(joint[0].length);
  }
  if (rest.trim()) throw new Error(t('"{text}" is unexpected; join conditions with "and" or "or"', { text: rest.trim() }));
  return (row) => either.some((all) => all.every((holds) => holds(row)));
}

// Names, with * for any letters: rows, or null if the text is a query.
function rowsNamed(text) {
  const words = text.toUpperCase().split(/[\s,;]+/).filter(Boolean);
  if (!words.length || /[=<>]|\s~/.test(text)) return null;
  const names = store.field.names.map((name) => name.toUpperCase());
  return [...new Set(words.flatMap((one) => {
    const rows = names.flatMap((name, row) => (OPERATORS["~"](name, one) ? [row] : []));
    if (!rows.length) throw new Error(missing(one, nearest(one, names)));
    return rows;
  }))];
}

const missing = (name, close) => (close ? t('there is no heliostat "{name}"; did you mean {close}?; write its name, or: state = TRACKING and error > 1', { name, close })
  : t('there is no heliostat "{name}"; write its name, or: state = TRACKING and error > 1', { name }));

function nearest(said, names) {
  const far = names.map((name) => edits(said, name)), least = far.reduce((a, b) => Math.min(a, b), Infinity);
  const close = names.flatMap((_, row) => (far[row] === least && least <= 2 ? [store.field.names[row]] : [])).slice(0, 3);
  return close.join(", ");
}

// Letters to add, leave out or change.
function edits(a, b) {
  let before = [...Array(b.length + 1).keys()];
  for (let i = 1; i <= a.length; i++) {
    const now = [i];
    for (let j = 1; j <= b.length; j++) now.push(Math.min(before[j] + 1, now[j - 1] + 1, before[j - 1] + (a[i - 1] === b[j - 1] ? 0 : 1)));
    before = now;
  }
  return before[b.length];
}

export function rowsWhere(text) {
  const named = rowsNamed(text);
  if (named) return named;
  const holds = parseQuery(text);
  return store.field.names.map((_, row) => row).filter(holds);
}
