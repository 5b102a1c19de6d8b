// Colours that the colour-blind can tell apart: Okabe and Ito's for kinds, cividis for amounts.
import { STALE, STATES, store } from "./live.js";
import { fixed, t } from "./words.js";

export const dark = () => !document.documentElement.classList.contains("light");

const KINDS = { // state: [on dark, on light]
  UNCONFIGURED: ["#8a8f98", "#6d7278"], STOWED: ["#5c7186", "#7f93a6"], STOWING: ["#a5bdd4", "#4f6b86"],
  APPROACHING: ["#56b4e9", "#1f8fd0"], IDLE: ["#3d86c6", "#0072b2"], TRACKING: ["#1fc49a", "#009e73"],
  DEFOCUSED: ["#f0e442", "#c8b400"], LOCKED: ["#cc79a7", "#b0568a"], SEARCHING: ["#e69f00", "#c98500"],
  FAULT: ["#ff6a2b", "#d55e00"], stale: ["#3b424b", "#c3c8ce"],
};
export const colourOf = (name) => (KINDS[name] ?? KINDS.stale)[dark() ? 0 : 1];

const CIVIDIS = ["#00224e", "#013271", "#2f426d", "#48526c", "#5e636f", "#727374", "#878478", "#9d9576",
  "#b6a96f", "#cebc63", "#e7d150", "#fee838"].map((c) => [1, 3, 5].map((i) => parseInt(c.slice(i, i + 2), 16)));
export function cividis(share) {
  const place = Math.min(1, Math.max(0, share)) * (CIVIDIS.length - 1);
  const i = Math.min(CIVIDIS.length - 2, Math.floor(place)), part = place - i;
  return CIVIDIS[i].map((c, k) => Math.round(c + part * (CIVIDIS[i + 1][k] - c)));
}
const css = (rgb) => `rgb(${rgb.join(",")})`;
// The dark end would be lost on a dark ground, the bright end on a light one.
const ramp = (share) => css(dark() ? cividis(0.22 + 0.78 * share) : cividis(0.88 * share));

const STEPS = 24;
const never = () => (dark() ? "#6a5560" : "#b9a3ae");
const mark = (v, low, high) => Math.min(1, Math.max(0, Math.log(v / low) / Math.log(high / low)));

// A view of the field: what class each row is in, the colour of each class, and a legend.
export const VIEWS = {
  state: {
    title: t("State"),
    of: (row) => { const s = store.stateOf(row); return s === STALE ? STATES.length : s; },
    colours: () => [...STATES, "stale"].map(colourOf),
    legend: () => {
      const counts = new Uint32Array(STATES.length + 1);
      for (let row = 0; row < store.state.length; row++) counts[VIEWS.state.of(row)]++;
      // All of them, so that the map does not change its size with them.
      return [...STATES, "stale"].map((name, i) => ({ name: t(name), colour: colourOf(name), count: counts[i] }));
    },
  },
  error: amounts(t("Predicted error (mrad)"), (row) => 1e3 * store.error[row], 0.1, 20,
    [[fixed(0.1, 1), 0.1], [fixed(0.5, 1), 0.5], ["2", 2], ["20", 20]]),
  measured: amounts(t("Last measured error (mrad)"), (row) => 1e3 * store.measured[row], 0.1, 20,
    [[fixed(0.1, 1), 0.1], [fixed(0.5, 1), 0.5], ["2", 2], ["20", 20]]),
  age: amounts(t("Age of calibration"), (row) => store.ageOf(row) / 3600, 0.05, 720,
    [["3 min", 0.05], ["1 h", 1], ["1 d", 24], ["30 d", 720]]),
  cluster: {
    title: t("Health of the cluster"),
    of: (row) => store.live ? (store.head?.clusters?.[store.field.cluster[row]] ?? 3) : 3,
    colours: () => [colourOf("TRACKING"), colourOf("DEFOCUSED"), colourOf("FAULT"), colourOf("stale")],
    legend: () => [t("healthy"), t("bad frames or nodes missing"), t("silent"), t("unknown")]
      .map((name, i) => ({ name, colour: VIEWS.cluster.colours()[i] })),
  },
};

function amounts(title, value, low, high, marks) {
  return {
    title, scale: { marks: marks.map(([text, v]) => [text, mark(v, low, high)]), ramp },
    of: (row) => {
      if (store.stateOf(row) === STALE) return STEPS + 1;
      const v = value(row);
      return Number.isNaN(v) ? STEPS : Math.round(mark(v, low, high) * (STEPS - 1));
    },
    colours: () => [...Array.from({ length: STEPS }, (_, i) => ramp(i / (STEPS - 1))), never(), colourOf("stale")],
    legend: () => [{ name: t("none yet"), colour: never() }, { name: t("stale"), colour: colourOf("stale") }],
  };
}
