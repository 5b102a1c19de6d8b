// The words of the page, in the language of its reader. The English text is the key; languages/*.json beside this file
// hold the others. What the plant itself says (events, refusals, alarms, reasons) stays English.
const KEPT = "heliotrope-language", LANGUAGES = ["en", "de", "es"], PATIENCE = 5000; // ms for a catalogue, then English

const wanted = [localStorage.getItem(KEPT), ...navigator.languages.map((one) => one.split("-")[0])];
export const language = wanted.find((one) => LANGUAGES.includes(one)) ?? LANGUAGES[0];

async function catalogue() {
  if (language === LANGUAGES[0]) return [];
  try {
    const answer = await fetch(new URL(`languages/${language}.json`, import.meta.url), { signal: AbortSignal.timeout(PATIENCE) });
    return Object.entries(await answer.json());
  } catch { return null; }
}

const texts = await catalogue();
const own = navigator.languages.find((one) => one.split("-")[0] === language) ?? language;
const ENGLISH = { locale: LANGUAGES[0], texts: new Map() };
let now = texts?.length ? { locale: own, texts: new Map(texts) } : ENGLISH;
const formats = new Map();

// A text in the language of the page, with values in place of its {names}.
export const t = (text, values = {}) => (now.texts.get(text) ?? text).replace(/\{(\w+)\}/g, (whole, name) => values[name] ?? whole);
// Marks a text that t() gets later, by a name.
export const word = (text) => text;

// Does something in English, with decimal points: files that programs read are the same for everybody.
export function english(make) {
  const before = now;
  now = ENGLISH;
  try { return make(); } finally { now = before; }
}

function format(given) {
  const key = `${now.locale} ${JSON.stringify(given)}`;
  if (!formats.has(key)) formats.set(key, new Intl.NumberFormat(now.locale, given));
  return formats.get(key);
}
export const fixed = (value, digits) => format({ minimumFractionDigits: digits, maximumFractionDigits: digits, useGrouping: false }).format(value);
export const whole = (value) => format({}).format(value);
// With as many digits as it has, at most six after the point.
export const plain = (value) => format({ maximumFractionDigits: 6, useGrouping: false }).format(value);
// A UTC day. English has two orders of day and month, so it keeps that of ISO 8601.
export function day(at) {
  const date = new Date(1e3 * at);
  return now === ENGLISH ? date.toISOString().slice(0, 10) : date.toLocaleDateString(now.locale, { timeZone: "UTC", year: "numeric", month: "2-digit", day: "2-digit" });
}
export function monthDay(at) {
  const date = new Date(1e3 * at);
  return now === ENGLISH ? date.toISOString().slice(5, 10) : date.toLocaleDateString(now.locale, { timeZone: "UTC", month: "2-digit", day: "2-digit" });
}

// The texts of the HTML file, and the choice of language where it has one.
function translate() {
  const keep = (node) => node.closest("script, style, [translate=no]");
  const walk = document.createTreeWalker(document.documentElement, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    const { currentNode: node } = walk, key = node.data.trim().replace(/\s+/g, " ");
    if (now.texts.has(key) && !keep(node.parentElement)) node.data = node.data.replace(/\S[^]*\S|\S/, () => t(key));
  }
  for (const name of ["title", "aria-label", "placeholder", "alt"]) {
    for (const one of document.querySelectorAll(`[${name}]`)) if (!keep(one)) one.setAttribute(name, t(one.getAttribute(name)));
  }
}

function offer(choice) {
  const title = (code) => { const name = new Intl.DisplayNames([code], { type: "language" }).of(code); return name[0].toUpperCase() + name.slice(1); };
  for (const code of LANGUAGES) choice.append(Object.assign(document.createElement("option"), { value: code, lang: code, textContent: title(code) }));
  choice.value = language;
  choice.addEventListener("change", () => { localStorage.setItem(KEPT, choice.value); location.reload(); });
}

// EMERGENCY's script, which stands before the rest of the page, may have asked for the words: its texts are all there once it is parsed.
if (document.readyState === "loading") await new Promise((wake) => document.addEventListener("readystatechange", wake, { once: true }));
document.documentElement.lang = now === ENGLISH ? LANGUAGES[0] : language;
translate();
const choice = document.getElementById("language");
if (choice) offer(choice);
