// Marking the corners of a target in its camera's picture: the dialog of the targets' tab.
import { api, store } from "./live.js";
import { h, lay } from "./dom.js";
import { clicking } from "./clicking.js";
import { t } from "./words.js";

const FEWEST = 4;

export async function markCorners(target) {
  const place = `targets/${encodeURIComponent(target)}/marks`, open = await api("POST", `${place}/picture`);
  const image = new Image();
  image.src = `/api/v1/pictures-to-mark/${open.number}`;
  await image.decode();
  return new Promise((resolve) => show(place, open, image, resolve));
}

function show(place, open, image, resolve) {
  const button = (title, go, kind = "") => h("button", { type: "button", className: `hx-button ${kind}`, onclick: go }, title);
  const parts = { picture: h("canvas", { className: "hx-mark-picture", tabIndex: 0, title: t("Picture of camera {name}", { name: open.camera }) }),
    glass: h("canvas", { className: "hx-mark-glass" }), sketch: h("canvas", { className: "hx-mark-sketch" }),
    ask: h("div", { className: "hx-mark-ask" }), list: h("ol", { className: "hx-mark-list" }) };
  const said = h("p", { className: "hx-told", role: "status" }), front = h("img", { className: "hx-mark-front", alt: t("The target from the front, by these points") });
  const fresh = () => ({ number: open.number, points: Object.fromEntries(clicks.found) });
  // What was tried last; other points must be tried anew before they are saved.
  let tried = "", busy = false;
  const words = (view) => [view.text, ...view.points.filter((p) => p.note).map((p) => `${p.name}: ${p.note}`)].join("\n");
  const send = async (save) => {
    const given = fresh();
    busy = true; told(); said.textContent = save ? t("Saving…") : t("Computing…"); said.classList.remove("bad");
    try {
      const view = await api("POST", place, { ...given, save });
      front.src = `data:image/jpeg;base64,${view.rectified}`;
      said.textContent = words(view);
      tried = JSON.stringify(given);
      said.scrollIntoView({ block: "start" });
      if (view.saved) {
        dialog.close();
        store.emit("said", { text: t("{target}: corners marked; {text}", { target: open.target, text: view.text }) });
        return;
      }
    } catch (error) { said.textContent = error.message; said.classList.add("bad"); }
    busy = false; told();
  };
  const undo = button(t("Undo"), () => clicks.undo()), skip = button(t("Skip"), () => clicks.skip());
  const preview = button(t("Preview"), () => send(false)), save = button(t("Save"), () => send(true), "main");
  const told = () => {
    const may = clicks.free(), missing = FEWEST - clicks.found.size;
    undo.disabled = busy || !may.undo;
    skip.disabled = busy || !may.skip;
    preview.disabled = busy || missing > 0;
    preview.title = missing > 0 ? t("{n} more points needed", { n: missing }) : "";
    const same = tried === JSON.stringify(fresh());
    front.classList.toggle("stale", !same);
    save.disabled = busy || !same || !store.mine;
    save.title = !store.mine ? t("Take command first") : same ? "" : t("Look at the preview first");
  };
  const dialog = h("dialog", { className: "hx-dialog hx-mark" }, h("h2", {}, t("Mark corners of {target} in camera {camera}", { target: open.target, camera: open.camera })),
    h("div", { className: "hx-mark-parts" }, parts.picture, h("aside", {}, parts.sketch, parts.ask, parts.glass, parts.list,
      h("p", { className: "hx-hint" }, t("Wheel: closer. Drag: move. Space: put the point where it is expected. Arrows: nudge the last point by ¼ px, with Shift by 4, with Ctrl by 40. S: skip, Backspace: undo.")),
      h("p", { className: "hx-hint" }, t("After saving: {text}.", { text: open.kept })), said, front)),
    h("div", { className: "hx-row" }, undo, skip, h("span", { className: "hx-mark-gap" }), button(t("Cancel"), () => dialog.close()), preview, save));
  const clicks = clicking(parts, { size: open.size, points: open.points, given: [], aspect: open.aspect }, image, () => told(), t);
  const off = store.on("authority", told);
  dialog.addEventListener("close", () => { clicks.close(); off(); resolve(); });
  lay(dialog);
  parts.picture.focus();
  clicks.start();
}
