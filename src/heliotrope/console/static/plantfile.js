// The plant file: an engineer edits its text, has it checked and stores it; the old one is kept.
import { api, me, store } from "./live.js";
import { ask, h, lay, moment } from "./dom.js";
import { askAnd } from "./orders.js";
import { t, word } from "./words.js";

const HOW = { changed: word("changed"), new: word("new"), removed: word("removed") };
let draft = null; // what was typed and not stored, while the dialog is closed

const listed = (differs) => differs.map((one) => `${`${one.table} ${one.name}`.trim()} (${one.how === "changed" && one.keys.length ? one.keys.join(", ") : t(HOW[one.how])})`).join("; ");
const changes = (lines) => h("pre", { className: "hx-changes" }, lines.map((line) => h("span", { className: line[0] === "+" ? "good" : line[0] === "-" ? "bad" : "" }, `${line}\n`)));

// The table of the line where the caret stands, as the help names it: `*` for a name that the plant chooses.
function tableAt(text, caret, help) {
  const end = text.indexOf("\n", caret), headers = [...text.slice(0, end < 0 ? text.length : end).matchAll(/^\s*\[\[?\s*([^\]\n]+?)\s*\]/gm)];
  const known = (name) => [...help.keys()].some((one) => one === name || one.startsWith(`${name}.`));
  let name = "";
  for (const part of (headers.at(-1)?.[1] ?? "").split(/\s*\.\s*/).filter(Boolean)) {
    const next = [part, "*"].map((one) => (name ? `${name}.${one}` : one)).find(known);
    if (!next) break;
    name = next;
  }
  return help.has(name) ? name : "";
}

export async function editPlantFile() {
  let view = await api("GET", "plant-file");
  const help = new Map((await api("GET", "plant-file/help")).map((one) => [one.table, one.keys]));
  const text = h("textarea", { className: "hx-toml", spellcheck: false, wrap: "off", rows: 22, ariaLabel: t("Text of the plant file") }), gutter = h("pre", { className: "hx-gutter", ariaHidden: "true" });
  const said = h("p", { className: "hx-told", role: "status" }), found = h("ul", { className: "hx-list hx-found" }), result = h("div"), state = h("div"), keys = h("aside", { className: "hx-keys-of" });
  const reason = h("input", { name: "reason", maxLength: 500, placeholder: t("Reason, kept with the version"), ariaLabel: t("Reason") });
  const tell = (words, bad) => { said.textContent = words; said.classList.toggle("bad", Boolean(bad)); };
  let based = view.version, wrong = new Map(), busy = false, helped = "", numbered = "";
  const button = (title, go, kind = "") => h("button", { type: "button", className: `hx-button ${kind}`, onclick: go }, title);
  const typed = () => text.value !== view.text;

  const number = () => {
    const lines = text.value.split("\n").length, now = [lines, ...wrong.keys()].join();
    if (now === numbered) return;
    numbered = now;
    gutter.replaceChildren(...Array.from({ length: lines }, (_, i) => h("span", { className: wrong.get(i + 1)?.severity === "error" ? "bad" : wrong.has(i + 1) ? "warn" : "", title: wrong.get(i + 1)?.text ?? "" }, `${i + 1}\n`)));
    gutter.scrollTop = text.scrollTop;
  };
  const explain = () => {
    const name = tableAt(text.value, text.selectionStart, help), line = text.value.slice(0, text.selectionStart).split("\n").length;
    const here = /^\s*([\w-]+)\s*=/.exec(text.value.split("\n")[line - 1])?.[1] ?? "";
    if (helped === `${name} ${here}`) return;
    helped = `${name} ${here}`;
    keys.replaceChildren(h("b", {}, name ? `[${name}]` : t("Keys of the whole file")), h("dl", {}, help.get(name).flatMap((one) => [
      h("dt", { className: one.key === here ? "now" : "" }, one.key, one.needed ? h("em", {}, ` ${t("required")}`) : ""), h("dd", {}, one.kind, one.text ? h("span", {}, one.text) : "")])));
    const now = keys.querySelector(".now");
    if (now) keys.scrollTop = now.offsetTop - 40; else keys.scrollTop = 0;
  };
  const go = (line) => {
    const lines = text.value.split("\n"), from = lines.slice(0, line - 1).reduce((sum, one) => sum + one.length + 1, 0);
    text.focus(); text.setSelectionRange(from, from + lines[line - 1].length);
    text.scrollTop = (line - 6) * (text.scrollHeight / lines.length);
    explain();
  };
  const changed = () => { draft = typed() || reason.value ? { text: text.value, based, reason: reason.value } : null; };
  const put = (value, version) => { text.value = value; text.setSelectionRange(0, 0); based = version; wrong = new Map(); helped = ""; found.replaceChildren(); result.replaceChildren(); number(); explain(); changed(); };
  text.oninput = () => { if (wrong.size) { wrong = new Map(); found.replaceChildren(); } result.replaceChildren(); number(); explain(); changed(); };
  text.onscroll = () => { gutter.scrollTop = text.scrollTop; };
  text.onclick = text.onkeyup = explain;
  reason.oninput = changed;

  const run = async (what) => {
    if (busy) return;
    busy = true;
    try { await what(); } catch (error) { tell(error.message, true); } finally { busy = false; }
  };
  // What the plant finds in the text, each error at its line; nothing is written.
  const check = async () => {
    const sent = text.value, seen = await api("POST", "plant-file/check", { text: sent });
    if (text.value !== sent) { tell(t("The text was changed meanwhile: check it again."), true); return null; }
    wrong = new Map(seen.findings.filter((one) => one.line).reverse().map((one) => [one.line, one]));
    found.replaceChildren(...seen.findings.map((one) => h("li", { className: one.severity === "error" ? "bad" : "warn" }, one.line ? [h("button", { type: "button", className: "hx-line-of", onclick: () => go(one.line) }, t("Line {n}", { n: one.line })), " "] : "", one.text)));
    number();
    result.replaceChildren(...(seen.difference.length ? [h("h3", {}, t("Changes to the present file")), changes(seen.difference)] : []));
    const first = seen.findings.find((one) => one.severity === "error");
    if (first?.line) go(first.line);
    if (first) tell(t("The text has an error; nothing was stored."), true);
    else if (!seen.differs.length) tell(t("No error. No value differs from those in use."));
    else if (seen.at_once) tell(t("No error. Used at once when stored, with the command authority ({who}): {tables}", { who: store.mine ? t("you have it") : t("take command first"), tables: listed(seen.differs) }));
    else tell(t("No error. When stored, it takes effect when the plant restarts: {tables}", { tables: listed(seen.differs) }));
    return first ? null : seen;
  };
  const keep = async () => {
    if (!reason.value.trim()) throw new Error(t("give the reason: it is kept with the version and in the audit"));
    if (!await check()) return;
    const done = await api("PUT", "plant-file", { text: text.value, version: based, reason: reason.value });
    reason.value = "";
    await load();
    put(done.version ? view.text : text.value, view.version);
    if (!done.version) draft = null;
    tell(done.text);
  };
  // The text on the left is replaced: what was typed and not stored is asked for first.
  const open = async (value, version, told) => {
    if (typed() && text.value !== value && !await ask(t("Replace what you typed? It was not stored."), [], t("Replace"))) return;
    put(value, version); tell(told);
  };
  const decide = (path, one) => (one.author === me.name ? [button(t("Withdraw"), () => run(async () => { await api("DELETE", path); await load(); tell(t("withdrawn")); }))]
    : [button(t("Approve"), () => run(async () => { const done = await api("POST", `${path}/approve`); await load(); put(view.text, view.version); tell(done.text); }), "main"),
      button(t("Refuse…"), () => askAnd(t("Refuse the change of {name}?", { name: t("the plant file") }), [{ name: "reason", label: t("Reason") }], t("Refuse"), async (v) => { await api("POST", `${path}/refuse`, v); await load(); }, t("refuse the change")))]);
  const waits = (one) => h("section", { className: "hx-why off hx-waiting" }, h("p", {}, h("b", {}, t("A new plant file waits for a second engineer"))), changes(one.difference),
    h("p", { className: "hx-hint" }, t("Asked for by {author} at {at}: {reason}. It ends by itself at {until}.", { author: one.author, at: moment(one.at), reason: one.reason, until: moment(one.until) })), h("div", { className: "hx-row" }, decide(`plant-file/waiting/${one.number}`, one)));
  const load = async () => {
    view = await api("GET", "plant-file");
    const again = (one) => run(async () => open(await api("GET", `plant-file/versions/${encodeURIComponent(one.name)}`), view.version, t("Version {name} is in the editor; store it to bring it back.", { name: one.name })));
    state.replaceChildren(...(view.writable ? [] : [h("p", { className: "warn" }, t("The plant's program may not write this file: texts can be checked here, and are stored on the plant's computer."))]),
      ...(view.problem ? [h("p", { className: "bad" }, t("The present file cannot be used: {problem}", { problem: view.problem }))] : []),
      ...(view.differs.length ? [h("p", { className: "warn hx-pending" }, t("Stored, and takes effect when the plant restarts: {tables}", { tables: listed(view.differs) }))] : []),
      ...(view.waiting ? [waits(view.waiting)] : []),
      h("details", {}, h("summary", {}, t("Stored versions ({n})", { n: view.versions.length })), h("ul", { className: "hx-list hx-kept" }, view.versions.map((one) => h("li", {}, button(t("Open"), () => again(one)), " ", one.name, h("em", {}, ` ${one.note}`))))));
  };

  const dialog = h("dialog", { className: "hx-dialog wide hx-plant-file hx-view" }, h("h2", {}, t("Plant file {name}", { name: view.file })), state,
    h("div", { className: "hx-editor" }, gutter, text, keys), found, result,
    h("div", { className: "hx-row hx-search" }, reason, button(t("Check"), () => run(check)), button(view.approval ? t("Ask for a second engineer") : t("Store"), () => run(keep), "main")),
    h("p", { className: "hx-hint" }, t("Nothing moves by it. Files beside the plant file, such as the table of heliostats, stay as they are.")), said,
    h("div", { className: "hx-row" }, button(t("Present file"), () => run(() => open(view.text, view.version, ""))), button(t("Close"), () => dialog.close(""))));
  await load();
  const before = draft;
  reason.value = before?.reason ?? "";
  put(before?.text ?? view.text, before?.based ?? view.version);
  if (before) tell(t("This is what you typed before; it is not stored."));
  lay(dialog);
}
