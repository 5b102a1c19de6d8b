// Fills the page, console.html, with its parts.
import { api, me, rowsWhere, store } from "./live.js";
import { CLICKS, FieldMap, SHAPES } from "./map.js";
import { heliostats } from "./table.js";
import { shift } from "./shift.js";
import { VIEWS } from "./palette.js";
import * as panels from "./panels.js";
import * as people from "./people.js";
import { act, AUTOMATIC, bar, say, whoCommands } from "./orders.js";
import { ask, count, h } from "./dom.js";
import { alertText, headOf } from "./showing.js";
import { t } from "./words.js";

function map(box) {
  const view = h("select", { title: t("Colour by (V)"), ariaLabel: t("Colour by"), onchange: () => store.emit("view", view.value) },
    Object.entries(VIEWS).map(([name, { title }]) => h("option", { value: name }, title)));
  const title = (name) => { const text = t(name); return text[0].toUpperCase() + text.slice(1); };
  const mode = h("select", { title: t("What a drag or a click on the map does; Shift and drag draws in every mode"), ariaLabel: t("Select by"), onchange: () => store.emit("mode", mode.value) },
    h("option", { value: "pan" }, t("Move the map")), h("optgroup", { label: t("Select by a drag") }, SHAPES.map((name) => h("option", { value: name }, title(name)))),
    h("optgroup", { label: t("Select by a click") }, CLICKS.map((name) => h("option", { value: name }, title(name)))));
  const all = h("button", { className: "hx-button", title: t("Show the whole field (0)"), onclick: () => store.emit("fit") }, t("Whole"));
  const none = h("button", { className: "hx-button", title: t("Clear (Escape)"), onclick: () => store.select([], -1) }, t("Clear"));
  const query = h("input", { type: "search", className: "hx-query", spellcheck: false, "aria-label": t("Query"),
    placeholder: t("P0097A, or state = TRACKING and error > 1"), title: t("Names of heliostats (* for any letters), or conditions. Fields: state, error, measured (mrad), age (h), sightings, fault, cluster, name, on, east, north. Operators: = != < > <= >= ~ (pattern with *). Press / to type here.") });
  const run = () => { try { const rows = rowsWhere(query.value); store.select(rows, rows.length === 1 ? rows[0] : -1); say(rows.length === 1 ? t("{name} is selected", { name: store.field.names[rows[0]] }) : t("{n} heliostats match", { n: count(rows.length) })); } catch (error) { say(error.message, true); } };
  query.addEventListener("keydown", (event) => { if (event.key === "Enter") run(); event.stopPropagation(); });
  const field = h("div", { className: "hx-map-field" });
  box.append(h("div", { className: "hx-tools" }, view, mode, all, none, query, h("button", { className: "hx-button", onclick: run }, t("Select"))), field);
  store.on("mode", (now) => { mode.value = now; });
  document.addEventListener("keydown", (event) => {
    if (event.key === "/" && !/INPUT|SELECT|TEXTAREA/.test(document.activeElement?.tagName)) { event.preventDefault(); query.focus(); }
  });
  new FieldMap(field);
}

function badge(box) {
  store.on("frame", (now) => { box.textContent = now.alarms ? count(now.alarms) : ""; });
}

function alert(box) {
  const viewer = me.role === "viewer";
  const back = h("button", { className: "hx-button", onclick: async () => {
    // Each person withdraws their own order; an engineer withdraws another's by the owner's name.
    const { calls } = store.head.order, owners = calls.map((call) => call.who), own = !calls.length || owners.includes(me.name);
    const by = (call) => `${call.who}: ${call.reason}`;
    const question = own ? t("Withdraw your emergency order? Nothing moves because of it.") : t("Withdraw another person's emergency order ({orders})? Nothing moves because of it.", { orders: calls.map(by).join("; ") });
    const given = await ask(question, own ? [] : [{ name: "owner", label: t("Whose"), options: owners }], t("Withdraw"));
    if (!given) return;
    try {
      const left = (await api("DELETE", "emergency", own ? undefined : { owner: given.owner })).calls;
      say(left.length ? t("withdrawn; still ordered by {orders}", { orders: left.map(by).join("; ") }) : t("emergency withdrawn; Resume ends it"));
    } catch (error) { say(error.message, true); }
  } }, t("Withdraw"));
  const resume = h("button", { className: "hx-button", onclick: async () => {
    const { holder } = store.head, held = holder && holder !== AUTOMATIC;
    const question = held ? t("Resume automatic control? It raises the heliostats that it had as soon as {who} releases command.", { who: holder }) : t("Resume automatic control? It raises the heliostats that it had.");
    if (!await ask(question, [], t("Resume"))) return;
    await act(async () => { await api("POST", "automatic/resume"); if (held) say(t("Automatic control goes on as soon as {who} releases command.", { who: holder })); }, t("Resume"), !held);
  } }, t("Resume"));
  alertText(box);
  box.append(viewer ? "" : back, viewer ? "" : resume);
  store.on("frame", (now) => {
    back.hidden = !now.emergency || !now.order.calls.length; resume.hidden = now.emergency ? now.order.calls.length > 0 : !now.resume;
  });
}

// The tabs: one panel at a time; the one that is left stops asking.
function tabs() {
  const buttons = [...document.querySelectorAll("[role=tab]")], panel = document.querySelector(".hx-panels");
  let end = null;
  const open = (button) => {
    end?.();
    for (const one of buttons) { one.ariaSelected = one === button; one.tabIndex = one === button ? 0 : -1; }
    const box = h("div", { className: `hx-view hx-${button.dataset.tab}` });
    panel.replaceChildren(box);
    panel.scrollTop = 0;
    panel.ariaLabel = button.firstChild.textContent;
    end = { ...panels, heliostats, shift }[button.dataset.tab](box);
  };
  buttons.forEach((button, i) => {
    button.onclick = () => open(button);
    button.onkeydown = ({ key }) => {
      const next = { ArrowRight: i + 1, ArrowLeft: i - 1, Home: 0, End: -1 }[key];
      if (next !== undefined) { const to = buttons.at(next % buttons.length); to.focus(); open(to); }
    };
  });
  open(buttons[0]);
}

// The person's menu, which any press elsewhere closes.
function menu(box) {
  const does = { ...people, factor: () => location.assign("/account"), trends: () => window.open("/trends", "_blank", "noopener"), wall: () => window.open("/wall", "_blank", "noopener"), async leave() { await api("DELETE", "session"); location.assign("/login"); } };
  const summary = box.querySelector("summary");
  summary.textContent = `${me.name} · ${t(me.role)}`;
  for (const item of box.querySelectorAll("button")) {
    if (item.dataset.role && item.dataset.role !== me.role) item.remove();
    item.onclick = () => { box.open = false; does[item.dataset.opens](); };
  }
  box.onkeydown = ({ key }) => { if (key === "Escape") { box.open = false; summary.focus(); } };
  document.addEventListener("pointerdown", (event) => { if (!box.contains(event.target)) box.open = false; });
}

const THEME = "heliotrope-theme", { classList } = document.documentElement, part = (name) => document.querySelector(`.hx-${name}`);
classList.toggle("light", localStorage.getItem(THEME) === "light");
part("theme").onclick = () => {
  localStorage.setItem(THEME, classList.toggle("light") ? "light" : "dark");
  store.emit("theme");
};
store.confirm = async () => {
  const given = await ask(t("Nothing was ordered here for a while. The view stays; give your password to go on."),
    [{ name: "own_password", label: t("Your own password"), type: "password" }], t("Go on"));
  if (given) await api("PUT", "session/presence", given);
  return Boolean(given);
};
menu(part("menu"));
bar(part("bar"));
store.start().then(() => {
  map(part("map")); headOf(part("head")); whoCommands(part("authority")); alert(part("alert")); badge(part("badge"));
  tabs();
});

window.heliotrope = { store }; // for tests and measurements
