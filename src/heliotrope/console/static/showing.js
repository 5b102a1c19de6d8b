// What the page and the wall screen both show: the head, what is open, and the flux on a receiver.
import { api, store } from "./live.js";
import { cividis, dark } from "./palette.js";
import { count, degrees, h, local, number, several } from "./dom.js";
import { day as dayOf, t } from "./words.js";

export function headOf(box) {
  const day = h("b", { className: "hx-day" }), time = h("b"), speed = h("span", { className: "hx-hint" }), sun = h("span", { className: "hx-sun" }), live = h("span", { className: "hx-live" });
  box.append(h("span", { className: "hx-name" }, store.field.plant), live, day, time, speed, sun);
  const show = () => {
    const now = store.head;
    if (!now) return;
    day.textContent = dayOf(Date.parse(`${now.at.slice(0, 10)}T00:00:00Z`) / 1e3);
    const here = local(now.utc);
    time.textContent = `${now.at.slice(11, 19)} UTC${here && ` · ${here} ${t("local")}`}`;
    speed.textContent = Math.abs(now.pace - 1) > 0.05 ? t("simulated at {pace} × real time", { pace: number(now.pace, now.pace < 10 ? 1 : 0) }) : "";
    sun.textContent = `☀ ${degrees(now.sun.azimuth, 0)}° ↑${degrees(now.sun.elevation, 0)}°`;
  };
  const mark = () => { live.textContent = store.live ? t("● live") : t("✕ NOT LIVE"); live.classList.toggle("bad", !store.live); document.body.classList.toggle("hx-dead", !store.live); };
  store.on("frame", show);
  store.on("live", mark);
  mark(); show();
}

// Heliostats of an emergency, by the name of their list in its view: the head of a frame names the first of many.
export const listed = (order, list, key, shown) => several(order[list], key, shown, list === "believed" ? order.believed_count : order.heliostats - order.done, async () => (await api("GET", "emergency"))[list]);

// The emergency, or why automatic control waits; the names are drawn anew only when they change, so that they stay unfolded under the hand.
export function alertText(box) {
  const text = h("span"), names = h("span"), shown = new Set();
  let drawn = "";
  box.append(h("div", {}, text, names));
  store.on("frame", (now) => {
    box.classList.toggle("on", now.emergency || Boolean(now.resume));
    box.classList.toggle("waits", !now.emergency);
    // Those that have not done it; then those of which only their own reports say so, which the text before has counted.
    const { order } = now, list = order.not_done.length ? "not_done" : "believed", like = JSON.stringify([now.emergency, list, order[list], order.done, order.believed_count]);
    if (like !== drawn) { drawn = like; names.replaceChildren(...(now.emergency && order[list].length ? [list === "believed" ? ": " : ` · ${t("not done")}: `, listed(order, list, "", shown)] : [])); }
    text.textContent = now.emergency ? [t("EMERGENCY {act} by {who}", { act: t(now.order.act), who: now.order.calls.length ? now.order.calls.map((call) => `${call.who} (${call.reason})`).join(", ") : now.order.who || t("the safety table") }),
      t("acknowledged {n} of {all}", { n: count(now.order.acknowledged), all: count(now.order.heliostats) }), t("done {n}", { n: count(now.order.done) }),
      now.order.calls.length ? "" : t("when the causes have gone, Resume ends it and gives the field back to automatic control"), now.order.basis].filter(Boolean).join(" · ") : now.resume;
  });
}

const halfOf = (centres) => centres.at(-1) + 0.5 * (centres[1] - centres[0]);

// The point of the unrolled receiver under the pointer, m right of and above its middle; null beside the picture.
export function fluxPoint(canvas, view, event) {
  const box = canvas.getBoundingClientRect(), scale = canvas.width / box.width;
  const x = ((event.clientX - box.left) * scale) / (canvas.width - 84), y = ((event.clientY - box.top) * scale) / (canvas.height - 22);
  return x >= 0 && x <= 1 && y >= 0 && y <= 1 ? [(2 * x - 1) * halfOf(view.right), (1 - 2 * y) * halfOf(view.up)] : null;
}

export function drawFlux(canvas, view, high = 190, letter = 11) {
  const rows = view.flux.length, columns = view.flux[0].length, peak = Math.max(1, ...view.flux.flat());
  const c = canvas.getContext("2d"), aspect = (view.right.at(-1) - view.right[0]) / Math.max(0.1, view.up.at(-1) - view.up[0]);
  const beside = 18 + 6 * letter, below = 2 * letter, room = canvas.parentElement.clientWidth - beside - 6, wide = Math.round(Math.max(120, Math.min(room, high * aspect)));
  canvas.width = wide + beside; canvas.height = high + below;
  const image = new ImageData(columns, rows);
  for (let y = 0; y < rows; y++) for (let x = 0; x < columns; x++) {
    const [r, g, b] = cividis(view.flux[rows - 1 - y][x] / peak);
    image.data.set([r, g, b, 255], 4 * (y * columns + x));
  }
  const small = h("canvas", { width: columns, height: rows });
  small.getContext("2d").putImageData(image, 0, 0);
  c.drawImage(small, 0, 0, wide, high);
  const ink = dark() ? "#c9d1d9" : "#24292f";
  for (let i = 0; i < high; i++) { c.fillStyle = `rgb(${cividis(1 - i / high).join(",")})`; c.fillRect(wide + 12, i, 12, 1); }
  c.fillStyle = ink; c.font = `${letter}px system-ui, sans-serif`; c.textAlign = "left";
  c.fillText(number(peak / 1e3, 0), wide + 28, letter - 1); c.fillText("kW/m²", wide + 28, 2.2 * letter); c.fillText("0", wide + 28, high);
  c.fillText(t("{width} × {height} m, seen from the field", { width: number(2 * halfOf(view.right), 1), height: number(2 * halfOf(view.up), 1) }), 0, high + 1.5 * letter);
}
