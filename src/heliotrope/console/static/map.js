// The field from above: up to 100,000 heliostats on a canvas, north at the top.
import { STALE, rowsWhere, store } from "./live.js";
import { VIEWS, colourOf, dark } from "./palette.js";
import { fixed, t, whole, word } from "./words.js";

const FAULT = 9;
const NEAR = 14; // px within which a click finds a heliostat
const ARC = 24; // corners of each arc of a sector
// What a drag (with Shift, or in that mode) draws, and what a click takes in its mode.
export const SHAPES = [word("lasso"), word("rectangle"), word("sector")], CLICKS = [word("row"), word("cluster")];
const KEYS = { l: "lasso", r: "rectangle", s: "sector" };

const words = new Map();
// A colour as the word of a pixel, little-endian: opaque, blue, green, red.
function wordOf(colour) {
  if (!words.has(colour)) {
    const parts = colour.startsWith("#") ? [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16)) : colour.match(/\d+/g).map(Number);
    words.set(colour, (0xff000000 | (parts[2] << 16) | (parts[1] << 8) | parts[0]) >>> 0);
  }
  return words.get(colour);
}

export class FieldMap {
  constructor(box) {
    this.box = box;
    this.view = "state";
    this.lasso = null;
    this.mode = "pan";
    this.shape = SHAPES[0];
    this.dirty = true;
    this.fitted = false;
    box.tabIndex = 0;
    box.setAttribute("role", "application");
    box.setAttribute("aria-label", t("Map of the field. Arrows move, plus and minus zoom, 0 shows all, L draws a lasso, R a rectangle, S a sector, A selects all, Escape clears."));
    box.dataset.dead = t("NOT LIVE: the plant has not been heard");
    this.canvas = box.appendChild(document.createElement("canvas"));
    this.context = this.canvas.getContext("2d", { alpha: false });
    this.tip = box.appendChild(Object.assign(document.createElement("div"), { className: "hx-tip" }));
    // Below the map, never over it: heliostats may be anywhere in it.
    this.legend = Object.assign(document.createElement("div"), { className: "hx-legend" });
    box.after(this.legend);
    for (const name of ["frame", "live", "theme"]) store.on(name, () => this.news());
    store.on("selection", () => { this.dirty = true; });
    store.on("view", (view) => { this.view = view; this.news(); });
    store.on("mode", (mode) => { this.mode = mode; if (SHAPES.includes(mode)) this.shape = mode; box.classList.toggle("lasso", mode !== "pan"); });
    store.on("fit", () => this.fit());
    new ResizeObserver(() => this.resize()).observe(box);
    this.hear();
    this.resize();
    this.fit();
    const turn = () => {
      if (this.dirty) { this.dirty = false; this.draw(); this.drawn(); }
      requestAnimationFrame(turn);
    };
    requestAnimationFrame(turn);
    window.heliotropeMap = this; // for measurements of its rate
  }

  // Marks the time at which the field is first shown live, for measurements.
  drawn() {
    if (!this.seen && store.live && this.x) { this.seen = true; performance.mark("heliotrope-ready"); }
  }

  news() { this.order = null; this.dirty = true; this.showLegend(); }

  resize() {
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    this.ratio = ratio;
    this.width = this.box.clientWidth;
    this.height = this.box.clientHeight;
    this.canvas.width = Math.max(1, Math.round(this.width * ratio));
    this.canvas.height = Math.max(1, Math.round(this.height * ratio));
    if (!this.moved) this.fit();
    this.dirty = true;
  }

  fit() {
    if (!this.width) return;
    const places = store.field.positions, n = places.length;
    this.x = Float32Array.from(places, (p) => p[0]);
    this.y = Float32Array.from(places, (p) => p[1]);
    let [west, east, south, north] = [0, 0, 0, 0];
    for (let i = 0; i < n; i++) {
      west = Math.min(west, this.x[i]); east = Math.max(east, this.x[i]);
      south = Math.min(south, this.y[i]); north = Math.max(north, this.y[i]);
    }
    const wide = Math.max(10, east - west), high = Math.max(10, north - south);
    this.scale = 0.92 * Math.min(this.width / wide, this.height / high);
    this.whole = this.scale;
    this.middle = [0.5 * (east + west), 0.5 * (north + south)];
    this.moved = false;
    this.news();
  }

  toScreen(x, y) {
    return [0.5 * this.width + (x - this.middle[0]) * this.scale, 0.5 * this.height - (y - this.middle[1]) * this.scale];
  }
  toField(px, py) {
    return [this.middle[0] + (px - 0.5 * this.width) / this.scale, this.middle[1] - (py - 0.5 * this.height) / this.scale];
  }

  zoom(factor, px = 0.5 * this.width, py = 0.5 * this.height) {
    const before = this.toField(px, py);
    this.scale = Math.min(200, Math.max(0.3 * this.whole, this.scale * factor));
    const after = this.toField(px, py);
    this.middle = [this.middle[0] + before[0] - after[0], this.middle[1] + before[1] - after[1]];
    this.moved = this.dirty = true;
  }
  pan(dx, dy) {
    this.middle = [this.middle[0] - dx / this.scale, this.middle[1] + dy / this.scale];
    this.moved = this.dirty = true;
  }

  // Rows by colour, so that the colour changes only once for each class.
  classes() {
    if (this.order) return this.order;
    const view = VIEWS[this.view], colours = view.colours();
    this.order = colours.map((colour) => ({ colour, rows: [] }));
    for (let row = 0; row < this.x.length; row++) this.order[view.of(row)].rows.push(row);
    return this.order;
  }

  draw() {
    const c = this.context, night = dark();
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    c.fillStyle = night ? "#12161b" : "#f4f5f6";
    c.fillRect(0, 0, this.width, this.height);
    if (!this.x) return;
    this.drawGround(c, night);
    const size = Math.max(2, Math.min(26, (store.field.size ?? 2.2) * this.scale * 0.85));
    const half = 0.5 * size;
    this.drawSquares(c, size);
    this.drawDistances(c, night);
    if (size > 14) this.drawNames(c, half, night);
    this.drawMarks(c, half, night);
    this.drawSun(c, night);
    this.drawLasso(c, night);
  }

  // Ten thousand squares are written as pixels: without a graphics card that takes a quarter of
  // the time of as many calls.
  drawSquares(c, size) {
    const { width: wide, height: high } = this.canvas;
    if (this.layer?.width !== wide || this.layer.height !== high) {
      this.layer = Object.assign(document.createElement("canvas"), { width: wide, height: high });
      this.ink = this.layer.getContext("2d");
      this.image = this.ink.createImageData(wide, high);
      this.pixels = new Uint32Array(this.image.data.buffer);
    }
    const pixels = this.pixels.fill(0), side = Math.max(2, Math.round(size * this.ratio)), k = this.scale * this.ratio;
    const ox = 0.5 * (wide - side) - this.middle[0] * k, oy = 0.5 * (high - side) + this.middle[1] * k;
    for (const { colour, rows } of this.classes()) {
      const word = wordOf(colour);
      for (const row of rows) {
        const left = Math.round(ox + this.x[row] * k), top = Math.round(oy - this.y[row] * k);
        const from = Math.max(0, left), to = Math.min(wide, left + side), end = Math.min(high, top + side);
        if (from >= to) continue;
        for (let y = Math.max(0, top); y < end; y++) pixels.fill(word, y * wide + from, y * wide + to);
      }
    }
    this.ink.putImageData(this.image, 0, 0);
    c.drawImage(this.layer, 0, 0, this.width, this.height);
  }

  drawGround(c, night) {
    const head = store.head, [tx, ty] = this.toScreen(store.field.tower[0], store.field.tower[1]);
    // Rings of distance around the tower.
    c.strokeStyle = night ? "#232a32" : "#dfe2e6"; c.lineWidth = 1;
    for (const distance of this.distances()) { c.beginPath(); c.arc(tx, ty, distance * this.scale, 0, 2 * Math.PI); c.stroke(); }
    // The tower's shadow, as long as the sun is up.
    if (store.live && head?.sun && head.sun.elevation > 0.02) {
      const length = Math.min(3000, store.field.tower[2] / Math.tan(head.sun.elevation)) * this.scale;
      c.strokeStyle = night ? "#05070a" : "#b4bac1"; c.lineWidth = Math.max(3, 8 * this.scale);
      c.beginPath(); c.moveTo(tx, ty);
      c.lineTo(tx - length * Math.sin(head.sun.azimuth), ty + length * Math.cos(head.sun.azimuth)); c.stroke();
    }
    c.fillStyle = night ? "#e8eaed" : "#202428";
    c.beginPath(); c.arc(tx, ty, 5, 0, 2 * Math.PI); c.fill();
    c.font = "11px sans-serif"; c.textAlign = "left"; c.fillText(t("tower"), tx + 8, ty - 6);
    this.drawKeepOuts(c, night);
  }

  distances() {
    const step = [5, 10, 20, 50, 100, 200, 500, 1000].find((s) => s * this.scale > 70) ?? 1000;
    return Array.from({ length: 12 }, (_, k) => (k + 1) * step);
  }

  drawDistances(c, night) {
    const [tx, ty] = this.toScreen(store.field.tower[0], store.field.tower[1]);
    c.font = "11px sans-serif"; c.textAlign = "left";
    for (const distance of this.distances()) this.write(c, `${distance} m`, tx + 4, ty + distance * this.scale - 4, night ? "#aab4bf" : "#57606a", night);
  }

  // A text above the squares: its edge has the colour of the ground, so that it is read and hides few of them.
  write(c, text, px, py, ink, night) {
    c.strokeStyle = night ? "#12161b" : "#f4f5f6"; c.lineWidth = 4; c.lineJoin = "round";
    c.strokeText(text, px, py);
    c.fillStyle = ink; c.fillText(text, px, py);
  }

  drawKeepOuts(c, night) {
    // Keep-out volumes.
    c.strokeStyle = c.fillStyle = night ? "#ff8a5c" : "#c04a00"; c.lineWidth = 1.5; c.setLineDash([6, 4]);
    for (const { name, outline } of store.field.keep_outs) {
      const places = outline.map(([east, north]) => this.toScreen(east, north));
      c.beginPath(); places.forEach(([px, py], i) => (i ? c.lineTo(px, py) : c.moveTo(px, py))); c.closePath(); c.stroke();
      const xs = places.map(([px]) => px), ys = places.map(([, py]) => py);
      const left = Math.min(...xs), wide = Math.max(...xs) - left;
      if (wide > 14) c.fillText(name, left, Math.min(...ys) - 5);
    }
    c.setLineDash([]);
  }

  drawMarks(c, half, night) {
    // Shape besides colour: faults carry a cross; stale heliostats are hollow when there is room.
    const n = this.x.length, ink = night ? "#ffffff" : "#000000";
    c.lineWidth = 1.5;
    for (let row = 0; row < n; row++) {
      if (store.stateOf(row) !== FAULT) continue;
      const [px, py] = this.toScreen(this.x[row], this.y[row]), r = Math.max(4, half + 1);
      c.strokeStyle = colourOf("FAULT");
      c.beginPath(); c.moveTo(px - r, py - r); c.lineTo(px + r, py + r); c.moveTo(px + r, py - r); c.lineTo(px - r, py + r); c.stroke();
    }
    // Out of service: a ring with a bar, drawn even where the state is unknown.
    c.strokeStyle = night ? "#ff5cc8" : "#a8006d"; c.lineWidth = 2;
    for (let row = 0; row < n; row++) {
      if (!store.out[row]) continue;
      const [px, py] = this.toScreen(this.x[row], this.y[row]), r = Math.max(6, half + 3);
      c.beginPath(); c.arc(px, py, r, 0, 2 * Math.PI); c.moveTo(px - r, py); c.lineTo(px + r, py);
      // Confirmed by the switch at the mirror: a second bar.
      if (store.out[row] === 2) { c.moveTo(px, py - r); c.lineTo(px, py + r); }
      c.stroke();
    }
    if (half > 3) {
      c.fillStyle = night ? "#12161b" : "#f4f5f6";
      for (let row = 0; row < n; row++) {
        if (store.stateOf(row) !== STALE) continue;
        const [px, py] = this.toScreen(this.x[row], this.y[row]);
        c.fillRect(px - half + 1.5, py - half + 1.5, 2 * half - 3, 2 * half - 3);
      }
    }
    c.fillStyle = c.strokeStyle = ink;
    const few = store.selection.size <= 3000 || half > 2;
    c.lineWidth = 1; c.beginPath();
    for (const row of store.selection) {
      const [px, py] = this.toScreen(this.x[row], this.y[row]);
      if (few) c.rect(px - half - 1.5, py - half - 1.5, 2 * half + 3, 2 * half + 3);
      else c.rect(px, py, 1, 1);
    }
    c.globalAlpha = few ? 0.9 : 0.6; c.stroke(); c.globalAlpha = 1;
    if (store.focus >= 0) {
      const [px, py] = this.toScreen(this.x[store.focus], this.y[store.focus]);
      c.lineWidth = 2; c.beginPath(); c.arc(px, py, half + 7, 0, 2 * Math.PI); c.stroke();
    }
    for (const [name, ring] of (store.head?.measuring ?? []).map((m) => [m.heliostat, m.target])) {
      const row = store.index.get(name);
      if (row === undefined) continue;
      const [px, py] = this.toScreen(this.x[row], this.y[row]);
      c.strokeStyle = colourOf("SEARCHING"); c.lineWidth = 2;
      c.beginPath(); c.arc(px, py, half + 5, 0, 2 * Math.PI); c.stroke();
      const text = `${name} → ${ring}`;
      c.font = "600 11px sans-serif"; c.textAlign = "left";
      // On the side that has room for it.
      const wide = c.measureText(text).width, left = px + half + 10 + wide > this.width ? px - half - 10 - wide : px + half + 10;
      this.write(c, text, left, py + 4, night ? "#f2b134" : "#8a5a00", night);
    }
  }

  // The names in view; one that would lie on an earlier one is left out until there is room for it.
  drawNames(c, half, night) {
    c.fillStyle = night ? "#c9d1d9" : "#24292f"; c.font = "10px sans-serif"; c.textAlign = "center";
    const high = 11, lines = new Map();
    for (let row = 0; row < this.x.length; row++) {
      const [px, py] = this.toScreen(this.x[row], this.y[row]), name = store.field.names[row];
      if (px < -20 || py < -20 || px > this.width + 20 || py > this.height + 20) continue;
      const wide = c.measureText(name).width + 4, line = Math.floor(py / high);
      const near = [line - 1, line, line + 1].flatMap((one) => lines.get(one) ?? []);
      if (near.some(([x, y, w]) => Math.abs(y - py) < high && 2 * Math.abs(x - px) < w + wide)) continue;
      lines.set(line, [...(lines.get(line) ?? []), [px, py, wide]]);
      c.fillText(name, px, py + half + 10);
    }
  }

  drawSun(c, night) {
    const sun = store.head?.sun, r = 34, cx = this.width - r - 16, cy = r + 22;
    c.strokeStyle = night ? "#3a434d" : "#b9c0c7"; c.lineWidth = 1;
    c.beginPath(); c.arc(cx, cy, r, 0, 2 * Math.PI); c.stroke();
    c.fillStyle = night ? "#9aa4af" : "#57606a"; c.font = "11px sans-serif"; c.textAlign = "center";
    c.fillText(t("N"), cx, cy - r - 5);
    if (!sun || !store.live) { c.fillText(t("sun not known"), cx, cy + 4); return; }
    const away = r * Math.cos(Math.max(0, sun.elevation));
    const sx = cx + away * Math.sin(sun.azimuth), sy = cy - away * Math.cos(sun.azimuth);
    c.strokeStyle = c.fillStyle = sun.elevation > 0 ? (night ? "#f0e442" : "#b38f00") : "#77808a";
    c.beginPath(); c.moveTo(cx, cy); c.lineTo(sx, sy); c.stroke();
    c.beginPath(); c.arc(sx, sy, 5, 0, 2 * Math.PI); sun.elevation > 0 ? c.fill() : c.stroke();
    c.fillStyle = night ? "#c9d1d9" : "#24292f";
    const degrees = (a) => (a * 180 / Math.PI).toFixed(0) + "°";
    c.fillText(`${degrees(sun.azimuth)}  ↑${degrees(sun.elevation)}`, cx, cy + r + 14);
  }

  // The outline of what is drawn, in pixels: a lasso that encloses nothing is the diagonal of a rectangle.
  outline() {
    const drawn = this.lasso, start = drawn[0], end = drawn.at(-1);
    if (this.shape === "sector") return this.sector(this.toField(...start), this.toField(...end));
    let area = 0;
    drawn.forEach(([x, y], i) => { const [u, v] = drawn[(i + 1) % drawn.length]; area += x * v - u * y; });
    const straight = Math.abs(area) < 0.1 * ((end[0] - start[0]) ** 2 + (end[1] - start[1]) ** 2);
    return this.shape === "lasso" && !straight ? drawn : [start, [end[0], start[1]], end, [start[0], end[1]]];
  }

  // A sector about the tower between two corners: by the shorter way round.
  sector(start, end) {
    const [e, n] = store.field.tower, polar = ([x, y]) => [Math.hypot(x - e, y - n), Math.atan2(x - e, y - n)];
    const [r, a] = polar(start), [far, b] = polar(end), turn = ((b - a + 3 * Math.PI) % (2 * Math.PI)) - Math.PI;
    const arc = (radius, from, by) => Array.from({ length: ARC + 1 }, (_, i) => { const at = from + (by * i) / ARC; return this.toScreen(e + radius * Math.sin(at), n + radius * Math.cos(at)); });
    return [...arc(r, a, turn), ...arc(far, a + turn, -turn)];
  }

  // The heliostats of one's cluster, or of its row: the ring about the tower or the straight line with most of them.
  beside(row) {
    if (row < 0) return [];
    const { cluster, tower } = store.field, all = [...cluster.keys()];
    if (this.mode === "cluster") return all.filter((other) => cluster[other] === cluster[row]);
    const gap = 0.35 * all.reduce((least, other) => (other === row ? least : Math.min(least, Math.hypot(this.x[other] - this.x[row], this.y[other] - this.y[row]))), Infinity);
    const by = [(i) => Math.hypot(this.x[i] - tower[0], this.y[i] - tower[1]), (i) => this.y[i], (i) => this.x[i]];
    return by.map((at) => all.filter((other) => Math.abs(at(other) - at(row)) <= gap)).reduce((a, b) => (b.length > a.length ? b : a));
  }

  drawLasso(c, night) {
    if (!this.lasso || this.lasso.length < 2) return;
    c.strokeStyle = night ? "#ffffff" : "#000000"; c.lineWidth = 1.5; c.setLineDash([5, 4]);
    c.beginPath(); this.outline().forEach(([x, y], i) => (i ? c.lineTo(x, y) : c.moveTo(x, y)));
    c.closePath(); c.stroke(); c.setLineDash([]);
    c.fillStyle = night ? "#ffffff18" : "#00000012"; c.fill();
  }

  showLegend() {
    const view = VIEWS[this.view], box = this.legend;
    if (!this.x) return;
    const out = store.out.reduce((sum, one) => sum + (one > 0), 0);
    box.replaceChildren(Object.assign(document.createElement("b"), { textContent: view.title }));
    if (view.scale) {
      const bar = document.createElement("canvas");
      bar.width = 180; bar.height = 26;
      const c = bar.getContext("2d");
      for (let i = 0; i < 180; i++) { c.fillStyle = view.scale.ramp(i / 179); c.fillRect(i, 0, 1, 10); }
      c.fillStyle = dark() ? "#c9d1d9" : "#24292f"; c.font = "10px sans-serif";
      for (const [text, place] of view.scale.marks) {
        c.textAlign = place < 0.05 ? "left" : place > 0.95 ? "right" : "center";
        c.fillText(text, place * 179, 23);
      }
      box.append(bar);
    }
    for (const { name, colour, count } of view.legend()) {
      const line = document.createElement("div"), patch = document.createElement("i");
      patch.style.background = colour;
      line.append(patch, count === undefined ? name : `${name} ${whole(count)}`);
      box.append(line);
    }
    if (out) box.append(Object.assign(document.createElement("div"), { className: "hx-out", textContent: `⊖ ${t("out of service")} ${whole(out)}` }));
  }

  nearest(px, py) {
    let best = -1, least = NEAR * NEAR;
    for (let row = 0; row < this.x.length; row++) {
      const [x, y] = this.toScreen(this.x[row], this.y[row]);
      const away = (x - px) ** 2 + (y - py) ** 2;
      if (away < least) { least = away; best = row; }
    }
    return best;
  }

  inside(polygon) {
    const points = polygon.map(([x, y]) => this.toField(x, y)), found = [];
    for (let row = 0; row < this.x.length; row++) {
      let odd = false;
      for (let i = 0, j = points.length - 1; i < points.length; j = i++) {
        const [xi, yi] = points[i], [xj, yj] = points[j], y = this.y[row];
        if (yi > y !== yj > y && this.x[row] < ((xj - xi) * (y - yi)) / (yj - yi) + xi) odd = !odd;
      }
      if (odd) found.push(row);
    }
    return found;
  }

  // Selects what a shape encloses, and says how many that are.
  tell(rows, event, shape) {
    this.choose(rows, event);
    store.emit("said", { text: rows.length ? t("{n} heliostats in the {shape}", { n: whole(rows.length), shape: t(shape) }) : t("no heliostat in the {shape}", { shape: t(shape) }), bad: !rows.length });
  }

  choose(rows, event, focus) {
    const add = event.ctrlKey || event.metaKey, before = add ? new Set(store.selection) : new Set();
    for (const row of rows) add && before.has(row) && rows.length === 1 ? before.delete(row) : before.add(row);
    store.select(before, focus);
  }

  hear() {
    const box = this.box, pointers = new Map();
    let start = null, spread = 0;
    const at = (event) => { const r = box.getBoundingClientRect(); return [event.clientX - r.left, event.clientY - r.top]; };
    box.addEventListener("pointerdown", (event) => {
      box.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, at(event));
      start = at(event);
      if (pointers.size === 1 && (event.shiftKey || SHAPES.includes(this.mode))) this.lasso = [start];
    });
    box.addEventListener("pointermove", (event) => {
      const place = at(event), before = pointers.get(event.pointerId);
      if (!before) { this.hover(place); return; }
      pointers.set(event.pointerId, place);
      if (pointers.size === 2) {
        const [a, b] = [...pointers.values()], wide = Math.hypot(a[0] - b[0], a[1] - b[1]);
        if (spread) this.zoom(wide / spread, 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]));
        spread = wide; this.lasso = null;
      } else if (this.lasso) { this.lasso.push(place); this.dirty = true; }
      else this.pan(place[0] - before[0], place[1] - before[1]);
    });
    const up = (event) => {
      const place = at(event);
      pointers.delete(event.pointerId); spread = 0;
      if (!start) return;
      if (Math.hypot(place[0] - start[0], place[1] - start[1]) < 4 && (this.lasso?.length ?? 0) < 5) {
        const row = this.nearest(...place);
        if (CLICKS.includes(this.mode)) this.tell(this.beside(row), event, this.mode);
        else this.choose(row < 0 ? [] : [row], event, row);
      } else if (this.lasso) {
        this.tell(this.inside(this.outline()), event, this.shape);
      }
      this.lasso = null; start = null; this.dirty = true;
    };
    box.addEventListener("pointerup", up);
    box.addEventListener("pointercancel", (event) => { pointers.delete(event.pointerId); this.lasso = null; });
    box.addEventListener("pointerleave", () => { this.tip.style.display = "none"; });
    box.addEventListener("wheel", (event) => { event.preventDefault(); this.zoom(Math.exp(-0.0015 * event.deltaY), ...at(event)); }, { passive: false });
    box.addEventListener("keydown", (event) => {
      const moves = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] };
      if (moves[event.key]) this.pan(...moves[event.key]);
      else if (event.key === "+" || event.key === "=") this.zoom(1.25);
      else if (event.key === "-") this.zoom(0.8);
      else if (event.key === "0") this.fit();
      else if (KEYS[event.key]) store.emit("mode", this.mode === KEYS[event.key] ? "pan" : KEYS[event.key]);
      else if (event.key === "a") store.select(rowsWhere("east >= -1e9"));
      else if (event.key === "Escape") { this.lasso = null; store.emit("mode", "pan"); store.select([], -1); }
      else return;
      event.preventDefault();
    });
  }

  hover([px, py]) {
    const row = this.nearest(px, py), tip = this.tip;
    if (row < 0) { tip.style.display = "none"; return; }
    const error = 1e3 * store.error[row];
    tip.textContent = [store.field.names[row], t(store.stateName(row)), Number.isNaN(error) ? t("not calibrated") : `±${fixed(error, 2)} mrad`,
      store.out[row] === 2 ? t("OUT OF SERVICE, confirmed at the mirror") : store.out[row] ? t("OUT OF SERVICE") : ""].filter(Boolean).join(" · ");
    tip.style.display = "block";
    tip.style.left = `${Math.min(px + 14, this.width - 190)}px`;
    tip.style.top = `${py + 14}px`;
  }
}
