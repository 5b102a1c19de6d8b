// Clicking the points of a target in a picture: `heliotrope camera teach --click` and the console.
// `parts`: canvases picture, glass and sketch, the element ask, and the list (ol).
// `data`: size of the picture (px), points ({name, place, expected?}), given ({name, at}), and the target's aspect.
// `told` is called after every change; `t` puts values into the {names} of a text, and may translate it. Pixels: the centre of the first one is 0, 0.
const inEnglish = (text, values = {}) => text.replace(/\{(\w+)\}/g, (whole, name) => values[name] ?? whole);
export function clicking(parts, data, image, told, t = inEnglish) {
  const [width, height] = data.size;
  const found = new Map();          // name -> [x, y]
  const history = [];
  const state = { now: 0, last: null, mouse: null, over: false };
  const view = { scale: 1, x: 0, y: 0 };
  const ended = new AbortController();

  const fit = (canvas) => {
    const ratio = window.devicePixelRatio || 1;
    const [w, h] = [canvas.clientWidth, canvas.clientHeight];
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, w, h);
    return [pen, w, h];
  };
  const toPixel = (sx, sy) => [(sx - view.x) / view.scale - 0.5, (sy - view.y) / view.scale - 0.5];
  const inside = ([x, y]) => x >= -0.5 && y >= -0.5 && x <= width - 0.5 && y <= height - 0.5;
  const cross = (pen, x, y, colour, size = 9) => {
    for (const [line, ink] of [[4, "#000"], [2, colour]]) {
      pen.lineWidth = line;
      pen.strokeStyle = ink;
      pen.beginPath();
      for (const [a, b] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        pen.moveTo(x + 3 * a, y + 3 * b);
        pen.lineTo(x + size * a, y + size * b);
      }
      pen.stroke();
    }
  };
  const label = (pen, text, x, y) => {
    pen.font = "12px system-ui, sans-serif";
    pen.lineWidth = 3;
    pen.strokeStyle = "#000";
    pen.strokeText(text, x, y);
    pen.fillStyle = "#fff";
    pen.fillText(text, x, y);
  };
  const paint = (pen, scale, x, y) => {
    pen.imageSmoothingEnabled = scale < 2;
    pen.drawImage(image, x, y, width * scale, height * scale);
  };
  const marks = (pen, scale, x, y, named) => {
    const one = ([name, at], colour) => {
      const [sx, sy] = [(at[0] + 0.5) * scale + x, (at[1] + 0.5) * scale + y];
      cross(pen, sx, sy, colour);
      if (named) label(pen, name, sx + 10, sy - 6);
    };
    data.given.forEach((g) => one([g.name, g.at], "#8fd3ff"));
    found.forEach((at, name) => one([name, at], name === state.last ? "#ffe14d" : "#5dff7a"));
  };
  const drawPicture = () => {
    const [pen] = fit(parts.picture);
    paint(pen, view.scale, view.x, view.y);
    marks(pen, view.scale, view.x, view.y, true);
  };
  const drawGlass = () => {
    const [pen, w, h] = fit(parts.glass);
    const at = state.mouse || found.get(state.last);
    if (!at) return;
    const scale = Math.max(8, 2 * view.scale);
    const [x, y] = [w / 2 - (at[0] + 0.5) * scale, h / 2 - (at[1] + 0.5) * scale];
    paint(pen, scale, x, y);
    marks(pen, scale, x, y, false);
    cross(pen, w / 2, h / 2, "#ff5050", 14);
  };
  const drawSketch = () => {
    const [pen, w, h] = fit(parts.sketch);
    const a = Math.min(w - 16, (h - 16) * data.aspect), b = a / data.aspect;
    const box = [(w - a) / 2, (h - b) / 2, a, b];
    pen.strokeStyle = "#77808a";
    pen.strokeRect(...box);
    data.points.forEach((point, k) => {
      const x = box[0] + point.place[0] * box[2], y = box[1] + point.place[1] * box[3];
      pen.beginPath();
      pen.arc(x, y, k === state.now ? 6 : 3, 0, 7);
      pen.fillStyle = k === state.now ? "#2f7fd0" : found.has(point.name) ? "#3f9c54" : "#b4bac1";
      pen.fill();
    });
  };
  const tell = () => {
    const hint = document.createElement("span");
    const point = data.points[state.now];
    parts.ask.textContent = point ? t("Click on {name}", { name: point.name }) : t("That was all");
    hint.textContent = point ? t("{n} of {all}", { n: state.now + 1, all: data.points.length }) : t("Look once more, then go on");
    parts.ask.append(hint);
    parts.list.textContent = "";
    const row = (name, at, kind, pick) => {
      const item = document.createElement("li"), where = document.createElement("span");
      item.className = kind;
      item.textContent = name;
      where.textContent = at ? `${at[0].toFixed(2)}, ${at[1].toFixed(2)}` : "–";
      item.append(where);
      if (pick) item.addEventListener("click", pick);
      parts.list.append(item);
      // Not scrollIntoView, which scrolls the whole page too.
      if (kind === "now") parts.list.scrollTop = item.offsetTop - parts.list.offsetTop - parts.list.clientHeight / 2;
    };
    data.points.forEach((p, k) =>
      row(p.name, found.get(p.name), k === state.now ? "now" : "", () => { state.now = k; draw(); }));
    data.given.forEach((g) => row(g.name, g.at, "given", null));
    told();
  };
  const draw = () => { if (!state.over) { drawPicture(); drawGlass(); drawSketch(); tell(); } };
  const next = () => {
    state.now += 1;
    while (state.now < data.points.length && found.has(data.points[state.now].name)) state.now += 1;
  };
  const put = (at) => {
    const point = data.points[state.now];
    if (!point || !inside(at)) return;
    history.push([state.now, state.last, found.get(point.name)]);
    found.set(point.name, at);
    state.last = point.name;
    next();
    draw();
  };
  const undo = () => {
    if (!history.length) return;
    const [k, before, at] = history.pop();
    const name = data.points[k].name;
    if (at) found.set(name, at); else found.delete(name);
    [state.now, state.last] = [k, before];
    draw();
  };
  const skip = () => { if (state.now < data.points.length) { next(); draw(); } };

  const canvas = parts.picture, heard = { signal: ended.signal };
  let down = null;
  canvas.addEventListener("mousedown", (e) => {
    down = { x: e.offsetX, y: e.offsetY, ox: view.x, oy: view.y, moved: false };
  }, heard);
  window.addEventListener("mousemove", (e) => {
    if (state.over) return;
    const box = canvas.getBoundingClientRect();
    const [x, y] = [e.clientX - box.left, e.clientY - box.top];
    if (down) {
      down.moved ||= Math.hypot(x - down.x, y - down.y) > 4;
      if (down.moved) {
        [view.x, view.y] = [down.ox + x - down.x, down.oy + y - down.y];
        drawPicture();
      }
    }
    const at = toPixel(x, y);
    state.mouse = e.target === canvas && inside(at) ? at : null;
    drawGlass();
  }, heard);
  window.addEventListener("mouseup", (e) => {
    if (down && !down.moved && e.target === canvas && e.button === 0) put(toPixel(e.offsetX, e.offsetY));
    down = null;
  }, heard);
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    const factor = Math.exp(-0.002 * Math.max(-200, Math.min(200, e.deltaY)));
    const scale = Math.min(64, Math.max(0.02, view.scale * factor));
    view.x = e.offsetX - (e.offsetX - view.x) * (scale / view.scale);
    view.y = e.offsetY - (e.offsetY - view.y) * (scale / view.scale);
    view.scale = scale;
    draw();
  }, { passive: false, ...heard });
  window.addEventListener("keydown", (e) => {
    if (state.over || e.metaKey || e.altKey || /INPUT|SELECT|TEXTAREA/.test(e.target.tagName)) return;
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const step = steps[e.key], at = found.get(state.last), point = data.points[state.now];
    if (step && at) {
      const size = e.ctrlKey ? 40 : e.shiftKey ? 4 : 0.25;
      const moved = [at[0] + size * step[0], at[1] + size * step[1]];
      if (inside(moved)) found.set(state.last, moved);
      state.mouse = null;
      draw();
    } else if (e.ctrlKey) return;
    else if (e.key === " " && point && e.target.tagName !== "BUTTON") {
      state.mouse = null;
      put(point.expected ?? [0.5 * (width - 1), 0.5 * (height - 1)]);
    } else if (e.key === "Backspace") undo();
    else if (e.key === "s" || e.key === "S") skip();
    else return;
    // Keys of the page beneath have other meanings.
    e.preventDefault();
    e.stopImmediatePropagation();
  }, { capture: true, ...heard });
  window.addEventListener("resize", draw, heard);
  const start = () => {
    const [w, h] = [canvas.clientWidth, canvas.clientHeight];
    view.scale = Math.min((w - 20) / width, (h - 20) / height);
    view.x = (w - width * view.scale) / 2;
    view.y = (h - height * view.scale) / 2;
    draw();
  };
  const close = () => { state.over = true; ended.abort(); };
  const free = () => ({ undo: history.length > 0, skip: state.now < data.points.length });
  return { found, view, toPixel, undo, skip, start, close, free };
}
