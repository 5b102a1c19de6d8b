// Puts the parts of the page into the frame.
import { api, me, rowsWhere, store } from "./live.js";
import { FieldMap } from "./map.js";
import { VIEWS } from "./palette.js";
import * as panels from "./panels.js";
import * as people from "./people.js";
import { act, bar, say, whoCommands } from "./orders.js";
import { ask, count, degrees, h, span } from "./dom.js";

const ready = store.begun.catch((error) => say(`no data from the plant: ${error.message}`, true));

function map(box) {
  const view = h("select", { title: "Colour by (V)", onchange: () => store.emit("view", view.value) },
    Object.entries(VIEWS).map(([name, { title }]) => h("option", { value: name }, title)));
  const lasso = h("button", { className: "hx-button", title: "Draw a lasso (L, or Shift and drag)", onclick: () => store.emit("mode", lasso.classList.contains("main") ? "pan" : "lasso") }, "Lasso");
  const all = h("button", { className: "hx-button", title: "Show the whole field (0)", onclick: () => store.emit("fit") }, "Whole");
  const none = h("button", { className: "hx-button", title: "Clear (Escape)", onclick: () => store.select([], -1) }, "Clear");
  const query = h("input", { type: "search", className: "hx-query", spellcheck: false, "aria-label": "Query",
    placeholder: "P0097A, or state = TRACKING and error > 1", title: "Names of heliostats (* for any letters), or conditions. Fields: state, error, measured (mrad), age (h), sightings, fault, cluster, name, on, east, north. Operators: = != < > <= >= ~ (pattern with *). Press / to type here." });
  const run = () => { try { const rows = rowsWhere(query.value); store.select(rows, rows.length === 1 ? rows[0] : -1); say(rows.length === 1 ? `${store.field.names[rows[0]]} is selected` : `${count(rows.length)} heliostats match`); } catch (error) { say(error.message, true); } };
  query.addEventListener("keydown", (event) => { if (event.key === "Enter") run(); event.stopPropagation(); });
  const field = h("div", { className: "hx-map-field" });
  box.append(h("div", { className: "hx-tools" }, view, lasso, all, none, query, h("button", { className: "hx-button", onclick: run }, "Select")), field);
  const off = store.on("mode", (mode) => lasso.classList.toggle("main", mode === "lasso"));
  document.addEventListener("keydown", (event) => {
    if (event.key === "/" && !/INPUT|SELECT|TEXTAREA/.test(document.activeElement?.tagName)) { event.preventDefault(); query.focus(); }
  });
  const drawn = new FieldMap(field);
  return () => { off(); drawn.close(); };
}

function head(box) {
  const time = h("b"), speed = h("span", { className: "hx-hint" }), sun = h("span"), live = h("span", { className: "hx-live" });
  box.append(h("span", { className: "hx-plant" }, store.field.plant), live, time, speed, sun);
  const show = () => {
    const now = store.head;
    if (!now) return;
    time.textContent = `${now.at.slice(0, 10)} ${now.at.slice(11, 19)} UTC`;
    speed.textContent = now.extra?.speed && now.extra.speed !== 1 ? `×${now.extra.speed}` : now.lag > 2 ? `simulated time ${span(now.lag)} late` : "";
    sun.textContent = `☀ ${degrees(now.sun.azimuth, 0)}° ↑${degrees(now.sun.elevation, 0)}°`;
  };
  const mark = () => { live.textContent = store.live ? "● live" : "✕ NOT LIVE"; live.classList.toggle("bad", !store.live); document.body.classList.toggle("hx-dead", !store.live); };
  const off = [store.on("frame", show), store.on("live", mark)];
  mark(); show();
  return () => off.forEach((end) => end());
}

function badge(box) {
  const show = (now) => {
    box.textContent = now.alarms ? String(now.alarms) : "";
    document.body.classList.toggle("hx-emergency", now.emergency);
  };
  return store.on("frame", show);
}

function alert(box) {
  const text = h("span"), viewer = me.role === "viewer";
  const back = h("button", { className: "hx-button", onclick: async () => {
    // Each person withdraws their own order; an engineer withdraws another's by the owner's name.
    const { calls } = store.head.order, owners = calls.map((call) => call.who), own = !calls.length || owners.includes(me.name);
    const by = (call) => `${call.who}: ${call.reason}`;
    const whose = own ? "your emergency order" : `another person's emergency order (${calls.map(by).join("; ")})`;
    const given = await ask(`Withdraw ${whose}? Nothing moves because of it; alarms that remain must be acknowledged.`, own ? [] : [{ name: "owner", label: "Whose", options: owners }], "Withdraw");
    if (!given) return;
    try {
      const left = (await api("DELETE", "emergency", own ? undefined : { owner: given.owner })).calls;
      say(left.length ? `withdrawn; still ordered by ${left.map(by).join("; ")}` : "emergency withdrawn; acknowledge the alarms that remain");
    } catch (error) { say(error.message, true); }
  } }, "Withdraw");
  const resume = h("button", { className: "hx-button", onclick: async () => {
    if (await ask("Resume automatic control? It raises the heliostats that it has lost.", [], "Resume")) await act(() => api("POST", "automatic/resume"), "Resume");
  } }, "Resume");
  box.append(text, viewer ? "" : back, viewer ? "" : resume);
  new ResizeObserver(() => document.body.style.setProperty("--alert", `${box.offsetHeight}px`)).observe(box);
  return store.on("frame", (now) => {
    box.classList.toggle("on", now.emergency || Boolean(now.resume));
    box.classList.toggle("waits", !now.emergency);
    back.hidden = !now.emergency || !now.order.calls.length; resume.hidden = !now.resume;
    text.textContent = now.emergency ? `EMERGENCY ${now.order.act} by ${now.order.calls.length ? now.order.calls.map((call) => `${call.who} (${call.reason})`).join(", ") : now.order.who || "the safety table"} · acknowledged ${count(now.order.acknowledged)} of ${count(now.order.heliostats)} · done ${count(now.order.done)} · ${now.order.basis}${now.order.calls.length ? "" : " · acknowledge its alarms (tab Alarms) when their causes have gone"}` : now.resume;
  });
}

const PARTS = { map, head, bar, badge, alert, authority: whoCommands, ...panels };

export function mount(kind, box) {
  let end = null, over = false;
  ready.then(() => { if (!over && store.field) end = PARTS[kind](box); });
  return () => { over = true; end?.(); };
}

window.heliotrope = {
  theme() {
    const night = !document.body.classList.contains("body--dark");
    Quasar.Dark.set(night);
    localStorage.setItem("heliotrope-theme", night ? "dark" : "light");
    setTimeout(() => store.emit("theme"), 50);
  },
  open: (part) => people[part](),
  async leave() { await api("DELETE", "session"); location.assign("/login"); },
  store,
};
const wanted = localStorage.getItem("heliotrope-theme");
if (wanted) { Quasar.Dark.set(wanted === "dark"); setTimeout(() => store.emit("theme"), 50); }
