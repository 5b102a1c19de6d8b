// The page's language: t("English text") gives the text of the catalogue LANGUAGE.json, or the English one.
export const LANGUAGES = { en: "English", de: "Deutsch", es: "Español" };
const KEPT = "heliotrope-language";

function chosen() {
  const wanted = [localStorage.getItem(KEPT), ...navigator.languages].filter(Boolean);
  return wanted.map((one) => one.slice(0, 2).toLowerCase()).find((one) => one in LANGUAGES) ?? "en";
}
export const language = chosen();
document.documentElement.lang = language;
const WORDS = language === "en" ? {} : await fetch(new URL(`${language}.json`, import.meta.url)).then((answer) => answer.json()).catch(() => ({}));

// A text with the values of its {names}.
export function t(text, values) {
  const said = WORDS[text] ?? text;
  return values ? said.replace(/\{(\w+)\}/g, (whole, name) => values[name] ?? whole) : said;
}

export function speak(which) { localStorage.setItem(KEPT, which); location.reload(); }

// Translates what stands in the HTML itself: texts, titles, labels.
export function translate(root) {
  const walk = document.createTreeWalker(root, NodeFilter.SHOW_TEXT);
  for (let node = walk.nextNode(); node; node = walk.nextNode()) {
    const text = node.data.trim();
    if (text) node.data = node.data.replace(text, t(text));
  }
  for (const name of ["title", "aria-label", "placeholder"]) {
    for (const one of root.querySelectorAll(`[${name}]`)) one.setAttribute(name, t(one.getAttribute(name)));
  }
}
