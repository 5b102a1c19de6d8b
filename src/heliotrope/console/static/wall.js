// A page for a wall screen: map, flux, power, alarms. Nothing to click but EMERGENCY.
import { api, store } from "./live.js";
import { FieldMap } from "./map.js";
import { alertText, drawFlux, headOf } from "./showing.js";
import { clock, count, h, number, refreshed } from "./dom.js";
import { colourOf } from "./palette.js";
import { t } from "./words.js";

const part = (name) => document.querySelector(`.hx-${name}`), SEVERE = { emergency: "bad", alarm: "bad", fault: "bad", warning: "warn" };

function figures(box) {
  const power = h("dl", { className: "hx-large" }), states = h("div"), flux = h("canvas", { className: "hx-flux", role: "img", ariaLabel: t("Predicted flux on the receiver") }), alarms = h("div");
  box.append(power, states, flux, h("h3", {}, t("Alarms")), alarms);
  const { receivers: [name] } = store.field;
  let seen = null;
  const large = (label, value) => h("div", {}, h("dt", {}, label), h("dd", {}, value));
  const show = () => {
    const { head } = store, reading = (of, digits, unit) => (head.readings[of] === undefined || head.readings[of] === null ? "–" : `${number(head.readings[of], digits)} ${unit}`);
    power.replaceChildren(large(t("Power, predicted"), seen ? `${number(seen.power / 1e6, 2)} MW` : "–"), large(t("Tracking"), `${count(head.states.TRACKING ?? 0)} / ${count(head.heliostats)}`),
      large(t("Direct sunlight"), reading("dni", 0, "W/m²")), large(t("Wind gust"), reading("wind_gust", 1, "m/s")));
    states.replaceChildren(h("div", { className: "hx-bars" }, Object.entries(head.states).map(([state, n]) => {
      const bar = h("i"); bar.style.width = `${Math.max(1, (100 * n) / head.heliostats)}%`; bar.style.background = colourOf(state);
      return h("div", {}, h("span", {}, t(state)), h("b", {}, bar), h("em", {}, count(n)));
    })));
  };
  store.on("frame", show);
  if (name) refreshed(async () => { seen = await api("GET", `receivers/${encodeURIComponent(name)}/flux`); drawFlux(flux, seen, 300, 15); show(); }, { every: 10 });
  refreshed(async () => {
    const rows = (await api("GET", "alarms")).filter((one) => one.active || !one.acknowledged_by);
    alarms.replaceChildren(...(rows.length ? rows.slice(0, 12).map((one) => h("p", { className: `hx-wall-alarm ${one.active ? SEVERE[one.severity] ?? "warn" : ""}` }, h("b", {}, `${one.active ? "▲" : "○"} ${clock(one.at)} ${one.subject}`), ` ${one.text}`)) : [h("p", { className: "good" }, t("No alarms."))]),
      rows.length > 12 ? h("p", {}, t("and {n} more", { n: count(rows.length - 12) })) : "");
  }, { key: () => store.head?.alarms, every: 4 });
  if (store.head) show();
}

document.documentElement.classList.toggle("light", localStorage.getItem("heliotrope-theme") === "light");
store.start().then(() => { new FieldMap(part("map-field")); headOf(part("head")); alertText(part("alert")); figures(part("side")); });
window.heliotrope = { store }; // for tests
