// The tabs of the page.
import { api, me, store } from "./live.js";
import { colourOf, dark } from "./palette.js";
import { ask, chart, clock, count, degrees, facts, h, moment, mrad, number, refreshed, saveCsv, several, span, table } from "./dom.js";
import { act, aim, askAnd } from "./orders.js";
import { drawFlux, fluxPoint, listed as listedIn } from "./showing.js";
import { markCorners } from "./marking.js";
import { editPlantFile } from "./plantfile.js";
import { compareVersions, waitingChanges, waitingView } from "./versions.js";
import { day as dayOf, fixed, monthDay, t, word } from "./words.js";

const look = (name) => { const row = store.index.get(name); if (row !== undefined) store.select([row], row); };
const canCommand = () => me.role !== "viewer";
const severe = { emergency: "bad", alarm: "bad", warning: "warn", fault: "bad" };

// Names, units, their number in one of the reading's, and digits.
const SENSORS = { dni: [word("Direct sunlight"), "W/m²", 1, 0], receiver_flux_nominal: [word("Flux on the receiver (share of the full field's)"), "%", 100, 0],
  wind_gust: [word("Wind gust (3 s)"), "m/s", 1, 1], wind_mean: [word("Mean wind (10 min)"), "m/s", 1, 1], temperature: [word("Air"), "°C", 1, 0] };

export function plant(box) {
  const states = h("div"), light = h("div"), proof = h("div"), flux = h("canvas", { className: "hx-flux" }), measured = h("div"), sensors = h("div");
  const { receivers } = store.field, figures = h("div"), limit = h("div");
  let [name] = receivers;
  const unfolded = new Set();
  let proven = "";
  const unsure = h("input", { type: "checkbox", onchange: () => draw() });
  const choice = h("select", { ariaLabel: t("Receiver"), onchange: () => { name = choice.value; predict(); } }, receivers.map((one) => h("option", { value: one }, one)));
  box.append(h("h3", {}, t("Heliostats")), states, proof, h("h3", {}, t("Sun")), light, sensors,
    ...(name ? [h("h3", {}, t("Predicted flux on the receiver")), receivers.length > 1 ? choice : "", figures, flux, h("label", { title: t("By the errors of the calibrations; sunlight, reflectivity and soiling come on top.") }, unsure, " ", t("Standard deviation")), measured, limit,
      canCommand() ? h("p", { className: "hx-hint" }, t("Click on the picture to aim the heliostats of the scope at that point.")) : ""] : []),
    me.role === "engineer" ? h("div", { className: "hx-row" }, h("button", { className: "hx-button", title: t("Targets, receivers, cameras and everything else that the plant file says: check a new text, store it, see its versions"),
      onclick: () => act(editPlantFile, t("plant file"), false) }, t("Plant file…"))) : "");
  let seen = null;
  const show = () => {
    const head = store.head;
    if (!head) return;
    const most = head.heliostats;
    states.replaceChildren(h("div", { className: "hx-bars" }, Object.entries(head.states).map(([state, n]) => {
      const bar = h("i"); bar.style.width = `${Math.max(1, (100 * n) / most)}%`; bar.style.background = colourOf(state);
      return h("div", {}, h("span", {}, t(state)), h("b", {}, bar), h("em", {}, count(n)));
    })), facts([[t("Clusters heard"), t("{n} of {all}", { n: count(head.clusters_alive), all: count(store.field.clusters.length) })],
      [t("Waiting to join the receiver"), count(head.waiting)],
      [t("Calibrated"), t("{n} of {all}", { n: count(head.calibration.done), all: count(most) })],
      [t("Median error"), head.calibration.quality ? `${mrad(head.calibration.quality.median)} mrad` : "–"]]));
    light.replaceChildren(facts([[t("Azimuth"), `${degrees(head.sun.azimuth, 1)}°`], [t("Elevation"), `${degrees(head.sun.elevation, 1)}°`],
      [t("Shadow of the tower"), head.sun.elevation > 0.02 ? t("{length} m to {azimuth}°", { length: number(store.field.tower[2] / Math.tan(head.sun.elevation), 0), azimuth: degrees((head.sun.azimuth + Math.PI) % (2 * Math.PI), 0) }) : t("none: the sun is down")]]));
    const readings = Object.entries(head.readings);
    sensors.replaceChildren(...(readings.length ? [h("h3", {}, t("Sensors")), facts(readings.map(([of, value]) => {
      const [label, unit, size, digits] = SENSORS[of] ?? [of.replaceAll("_", " "), "", 1, 2];
      return [t(label), value === null ? t("no reading") : `${number(size * value, digits)} ${unit}`];
    }))] : []));
    // Drawn anew only when it changes: what is unfolded keeps the keyboard's focus.
    const order = JSON.stringify({ ...head.order, seconds: 0 });
    if (order === proven) return;
    proven = order;
    proof.replaceChildren(...(head.order.on ? [h("p", { className: "hx-said bad" },
      t("{act} of the field, ordered by {who}: {acknowledged} of {all} acknowledged, {done} done", { act: t(head.order.act), who: head.order.who, acknowledged: count(head.order.acknowledged), all: count(head.order.heliostats), done: count(head.order.done) }), head.order.text && `; ${head.order.text}`), facts([
      [t("Measured"), head.order.measured ? t("the flux, below its limit") : t("nothing since the order")],
      [t("Seen to move today"), Object.entries(head.order.followed).map(([by, n]) => t("{n} by {by}", { n: count(n), by })).join(", ") || t("none")],
      ...(head.order.not_done.length ? [[t("Not done"), listedIn(head.order, "not_done", "not_done", unfolded)]] : []),
      [t("Believed by reports alone"), head.order.believed.length ? listedIn(head.order, "believed", "believed", unfolded) : t("none")]])] : []));
  };
  const draw = () => {
    if (!seen) return;
    drawFlux(flux, unsure.checked ? { ...seen, flux: seen.sigma } : seen);
    const map = Array.isArray(seen.measured) ? h("canvas", { className: "hx-flux" }) : "";
    measured.replaceChildren(...(seen.measured === null ? [] : [h("h3", {}, t("Measured flux on the receiver")), map || facts([[t("Mean"), `${number(seen.measured / 1e3, 0)} kW/m²`]])]));
    if (map) drawFlux(map, { ...seen, flux: seen.measured });
  };
  const within = (value, sigma, size, digits) => number(value / size, digits) + (sigma === null ? "" : ` ± ${number(sigma / size, digits)}`);
  const off = [store.on("frame", show), store.on("theme", () => { show(); draw(); })];
  const predict = async () => {
    try { seen = await api("GET", `receivers/${encodeURIComponent(name)}/flux`); } catch (error) {
      if (seen) throw error;
      figures.replaceChildren(h("p", { className: "hx-hint" }, error.message));
      return;
    }
    // Cells have none while beams of wide errors bring much of the light.
    unsure.disabled = seen.peak_sigma === null;
    unsure.checked &&= !unsure.disabled;
    figures.replaceChildren(facts([[t("Power"), `${within(seen.power, seen.power_sigma, 1e6, 2)} MW`],
      [t("Intercept"), seen.intercept === null ? "–" : `${number(100 * seen.intercept, 1)} %`],
      [t("Peak"), `${within(seen.peak, seen.peak_sigma, 1e3, 0)} kW/m²`], [t("Heliostats on it"), count(seen.heliostats)]]));
    limit.replaceChildren(...aimsView(await api("GET", "aims")));
    draw();
  };
  if (name) off.push(refreshed(predict, { every: 10 }));
  flux.onclick = (event) => {
    const point = seen && canCommand() ? fluxPoint(flux, seen, event) : null;
    if (point) aim(seen.receiver, ...point);
  };
  show();
  return () => off.forEach((end) => end());
}

// The flux limit, and how aims hold it; nothing where aims are spread.
function aimsView(aims) {
  if (aims.strategy !== "limit") return [];
  const share = (value) => value === null ? "–" : `${number(100 * value, 1)} %`, kilowatts = (value) => value === null ? "–" : number(value / 1e3, value > 0 && value < 1e4 ? 2 : 0);
  const named = (names) => `${count(names.length)}: ${names.slice(0, 5).join(", ")}${names.length > 5 ? ", …" : ""}`;
  const sources = { optimiser: t("optimiser"), "last good aims": t("last good aims"), "safe spread": t("safe spread") };
  const above = aims.reserve !== null && aims.reserve < 0;
  return [h("h3", {}, t("Flux limit")), ...(aims.problem ? [h("p", { className: "hx-said bad" }, aims.problem)] : []),
    ...(aims.idle ? [h("p", { className: "hx-hint" }, t("Nothing is moved: {why}", { why: aims.idle }))] : []), facts([
    [t("Aims by"), sources[aims.source] ?? t("none yet")], [t("Computed"), aims.at === null ? "–" : t("{age} ago", { age: span(aims.at) })],
    [t("Limit, and flux with its errors"), `${kilowatts(aims.limit)}, ${kilowatts(aims.peak)} kW/m²`],
    above ? [t("Above the limit"), share(-aims.reserve), "bad"] : [t("Left of the limit"), share(aims.reserve)], [t("Cells at the limit"), count(aims.binding)],
    [t("Power, and of the best aims"), `${kilowatts(aims.power)}, ${kilowatts(aims.planned)} kW`],
    [t("With an aim, at standby without one, still to move"), `${count(aims.aimed)}, ${count(aims.resting)}, ${count(aims.left)}`],
    ...(aims.waiting ? [[t("Waiting for the ramp"), count(aims.waiting)]] : []),
    ...(aims.by_hand.length ? [[t("Aimed by an operator"), named(aims.by_hand)]] : []),
    ...(aims.unlit.length ? [[t("Reach no cell"), named(aims.unlit)]] : []),
    [t("Moved last"), aims.moved.length ? t("{n}, {ago} ago: {names}", { n: count(aims.moved.length), ago: span(aims.moved_ago), names: aims.moved.slice(0, 5).join(", ") + (aims.moved.length > 5 ? ", …" : "") }) : t("none")]]),
    h("p", { className: "hx-hint" }, t("For full sun and beams that hit their aims. Poorly calibrated beams are spread more, so the prediction above can be lower."))];
}

export function heliostat(box) {
  const off = [], body = h("div");
  box.append(body);
  const load = async () => {
    if (store.focus < 0) {
      body.replaceChildren(h("p", { className: "hx-hint" }, store.selection.size
        ? t("{n} heliostats are selected. Click one on the map to see it here.", { n: count(store.selection.size) })
        : t("Click a heliostat on the map to see it here.")));
      return;
    }
    const name = encodeURIComponent(store.field.names[store.focus]);
    const [one, why, kept, waiting] = await Promise.all([api("GET", `heliostats/${name}`), api("GET", `heliostats/${name}/why`), api("GET", `photographs?heliostat=${name}&limit=40`), waitingChanges(store.field.names[store.focus])]);
    const ticket = await askedFor(one.name);
    body.replaceChildren(...heliostatView(one, [whyView(why), ...waiting.map((each) => waitingView(each))], calibrationView(one, kept, ticket)), ...keptView(kept, one.history));
    const canvas = body.querySelector("canvas");
    if (canvas && one.history.length) chart(canvas, [
      { points: one.history.map((s) => [s.at, 1e3 * s.error]), colour: colourOf("APPROACHING"), dots: true },
      { points: one.results.filter((r) => r.predicted !== null).map((r) => [r.at, 1e3 * r.predicted]), colour: colourOf("TRACKING") }], dark());
  };
  off.push(refreshed(load, { key: () => store.focus, every: 2 }));
  off.push(store.on("selection", load));
  return () => off.forEach((end) => end());
}

// What the button of an explanation does, and its title.
const ACTS = {
  automatic: [word("Give to automatic control"), (name) => api("POST", "automatic", { heliostats: [name] })],
  unlock: [word("Unlock"), (name) => api("POST", "commands", { command: "UNLOCK", heliostats: [name] })],
  clear_fault: [word("Clear fault"), (name) => api("POST", "commands", { command: "CLEAR_FAULT", heliostats: [name] })],
  return_lock: [word("Return your lock"), (name) => api("POST", "holds/release", { heliostats: [name] })],
  resume: [word("Resume"), () => api("POST", "automatic/resume")],
  withdraw: [word("Withdraw your emergency order"), () => api("DELETE", "emergency")],
};

function whyView(why) {
  const [title, does] = ACTS[why.button] ?? [];
  return h("section", { className: `hx-why ${why.tracks ? "" : "off"}` }, h("p", {}, h("b", {}, why.text)),
    why.follows ? h("p", {}, why.follows) : "",
    why.remedy || title ? h("p", {}, `${why.remedy} `, title && canCommand() ? h("button", { className: "hx-button", onclick: () => act(() => does(why.heliostat), t(title)) }, t(title)) : "") : "",
    why.order ? h("p", { className: "hx-hint" }, t("Last order: {what} by {who} at {time} UTC, {text}.", { what: why.order.what, who: why.order.who, time: clock(why.order.at), text: why.order.text })) : "",
    ...why.alarms.map((a) => h("p", { className: severe[a.severity] ?? "" }, a.text)));
}

// Calibrations asked for on this page, by heliostat, followed to their ends.
const asked = new Map();
async function calibrate(name, search) {
  const ticket = await api("POST", "calibration/next", search ? { heliostat: name, search } : { heliostat: name });
  asked.set(name, { identity: ticket.identity, since: store.head.utc });
  return ticket;
}
async function askedFor(name) {
  const known = asked.get(name);
  if (!known) return null;
  return { ...known, ...await api("GET", `commands/${encodeURIComponent(known.identity)}`).catch(() => ({ finished: true, text: "" })) };
}

// How far a calibration is that was asked for; then its result, with the first and the last photograph of its visit.
function calibrationView(one, kept, ticket) {
  const running = ticket && !ticket.finished, [last, before] = one.results.toSorted((a, b) => b.at - a.at);
  const parts = ticket && (running || !ticket.good) && ticket.text ? [h("p", { className: running ? "" : "bad", role: "status" }, running ? h("progress", {}) : "", " ", ticket.text, running ? ` (${span(store.head.utc - ticket.since)})` : "")] : [];
  if (last && !running) {
    const mine = kept.filter((p) => p.at <= last.at + 1 && p.at > (before?.at ?? 0)).toSorted((a, b) => a.at - b.at), pictures = [...new Set([mine[0], mine.at(-1)])].filter(Boolean);
    const sighting = (p) => one.history.find((s) => Math.abs(s.at - p.at) < 0.5);
    parts.push(facts([[t("Result"), t(last.outcome.replaceAll("_", " ")), last.outcome === "calibrated" ? "" : "warn"], [t("Time and target"), `${moment(last.at)}, ${last.target}`], [t("Beam error before"), `${mrad(last.before)} mrad`], [t("after"), `${mrad(last.after)} mrad`], [t("Photographs used"), count(last.new)]]),
      h("p", { className: "hx-hint" }, last.text),
      pictures.length ? h("div", { className: "hx-two" }, pictures.map((p, i) => h("figure", {}, h("a", { href: `/api/v1/photographs/${p.identity}`, target: "_blank", rel: "noopener" }, h("img", { src: `/api/v1/photographs/${p.identity}`, alt: t("Photograph of {target} at {at}", { target: p.target, at: clock(p.at) }), loading: "lazy" })),
        h("figcaption", { className: "hx-hint" }, `${i ? t("last") : t("first")}, ${clock(p.at)}${sighting(p) ? `, ${mrad(sighting(p).error)} mrad` : ""}`)))) : "");
  }
  return parts.length ? h("section", { className: "hx-result" }, h("h3", {}, running ? t("Calibration under way") : t("Last calibration")), parts) : "";
}

function heliostatView(one, why, calibration) {
  const stale = one.live ? "" : "hx-stale", point = (p) => (p[0] === null ? t("none") : p.map((v) => number(v, 1)).join(", "));
  return [
    h("h2", { className: stale }, one.name, h("span", { className: "hx-chip" }, one.live ? t(one.state) : t("stale: {age} old", { age: span(one.age) }))),
    ...why,
    canCommand() ? h("div", { className: "hx-row" }, h("button", { className: "hx-button", title: t("Automatic control calibrates it as soon as a target is free"),
      onclick: () => act(() => calibrate(one.name, false), t("calibrate {name}", { name: one.name })) }, t("Calibrate now")),
    h("button", { className: "hx-button", title: t("Automatic control searches its beam on a target until the camera sees it move with its aim; nothing is changed"),
      onclick: () => act(() => calibrate(one.name, true), t("search {name}", { name: one.name })) }, t("Search its beam"))) : "",
    calibration,
    facts([[t("Cluster"), one.cluster], [t("Heard"), t("{age} ago", { age: one.live ? `${number(one.age, 1)} s` : span(one.age) })],
      [t("Fault"), one.live ? t(one.fault) : t("unknown"), one.live && one.fault !== "none" ? "bad" : stale], [t("Aims at"), one.on === "elsewhere" ? t("elsewhere") : one.on || t("nothing")],
      [t("Aim E, N, U (m)"), point(one.aim)], [t("Standby E, N, U (m)"), point(one.standby)],
      [t("Position E, N, U (m)"), one.position.map((v) => number(v, 1)).join(", ")], [t("Mirror"), `${number(one.width, 1)} × ${number(one.height, 1)} m`],
      [t("Predicted error"), one.error === null ? t("never calibrated") : `${mrad(one.error)} mrad`],
      one.truth_error !== null ? [t("True error (twin)"), `${mrad(one.truth_error)} mrad`] : null,
      [t("Supply voltage"), one.supply === null ? "–" : `${number(one.supply, 1)} V`], [t("Temperature"), one.temperature === null ? "–" : `${number(one.temperature, 0)} °C`],
      [t("Next measurement"), one.planned ? t("{time} on {target}", { time: clock(one.planned.at), target: one.planned.target }) : t("not planned")],
      one.locked ? [t("Locked"), one.locked, "warn"] : null,
      one.hold ? [t("Out of service"), [one.hold, one.state === "STOWED" || one.flags.includes("AT_STOW") ? t("in stow") : t("NOT IN STOW"), one.flags.includes("LOCAL_SWITCH") ? t("confirmed at the mirror") : ""].filter(Boolean).join("; "), "warn"] : null,
      one.flags.includes("LOCAL_SWITCH") ? [t("Switch at the mirror"), t("drives off: nothing moves it"), "warn"] : null]),
    h("h3", {}, t("Drives")),
    one.drives.length ? table([[t("Axis"), (d) => t(d.axis)], [t("Count"), (d) => count(d.count), "num"], [t("Goal"), (d) => count(d.goal), "num"],
      [t("Angle (°)"), (d) => degrees(d.angle, 3), "num"], [t("Goal (°)"), (d) => degrees(d.goal_angle, 3), "num"]],
      one.drives.map((d, i) => ({ ...d, axis: [word("primary"), word("secondary")][i] }))) : h("p", { className: "hx-hint" }, t("unknown while stale")),
    h("div", { className: "hx-row" }, h("h3", {}, t("Parameters")), h("button", { className: "hx-button", onclick: () => act(() => compareVersions(one.name), t("versions"), false) }, t("Versions…"))),
    table([[t("Name"), (p) => p[0]], [t("Value"), (p) => parameter(p[1].value, p[1].unit), "num"], ["σ", (p) => parameter(p[1].sigma, p[1].unit), "num"],
      [t("Nominal"), (p) => parameter(p[1].nominal, p[1].unit), "num"], ["", (p) => (p[1].unit === "rad" ? "mrad" : p[1].unit)]], Object.entries(one.parameters)),
    h("h3", {}, t("Errors of its sightings ({n}), mrad", { n: count(one.history.length) })), h("canvas", { className: "hx-chart small" }),
    one.flags.length ? h("p", { className: "hx-hint" }, one.flags.join(" · ")) : "",
  ];
}

// The kept photographs, each with the error of its sighting: a sighting has the time of its photograph.
function keptView(kept, history) {
  const sighting = (p) => history.find((s) => Math.abs(s.at - p.at) < 0.5);
  return [h("h3", {}, t("Kept photographs ({n})", { n: count(kept.length) })), kept.length
    ? table([[t("Time"), (p) => h("a", { href: `/api/v1/photographs/${p.identity}`, target: "_blank", rel: "noopener" }, clock(p.at))], [t("Target"), (p) => p.target],
      [t("Sighting (mrad)"), (p) => { const s = sighting(p); return s ? mrad(s.error) : "–"; }, "num"],
      [t("Result of its visit"), (p) => h("span", { className: p.outcome === "calibrated" ? "good" : "warn", title: `${p.text}\n${p.reading.join("\n")}` }, p.used ? t(p.outcome.replaceAll("_", " ")) : t("not used: {why}", { why: p.reading.at(-1) ?? "" }))]], kept)
    : h("p", { className: "hx-hint" }, t("None yet."))];
}
const parameter = (value, unit) => (value === null ? "–" : unit === "rad" ? fixed(1e3 * value, 3) : fixed(value, 4));

export function targets(box) {
  const off = [], shown = new Map();
  for (const name of store.field.targets) {
    const image = h("img", { alt: t("Photograph of {name}", { name }) }), said = h("p", { className: "hx-reading" }), at = h("span", { className: "hx-chip" }, t("no photograph yet"));
    box.append(h("h3", {}, name, at), canCommand() ? h("div", { className: "hx-row" }, h("button", { className: "hx-button",
      onclick: () => act(() => api("POST", `targets/${encodeURIComponent(name)}/photograph`), t("photograph {name}", { name })) }, t("Photograph now")),
      me.role === "engineer" ? h("button", { className: "hx-button", title: t("Click the corners and marks of the target in its camera's picture: the perspective of later photographs"),
        onclick: () => act(() => markCorners(name), t("mark corners of {name}", { name }), false) }, t("Mark corners…")) : "") : "", h("div", { className: "hx-photo" }, image), said);
    shown.set(name, { image, said, at });
    off.push(refreshed(async () => {
      if (!store.head?.cameras?.[name]) return;
      const view = await api("GET", `targets/${encodeURIComponent(name)}`);
      image.src = `/api/v1/targets/${encodeURIComponent(name)}/photograph?${view.version}`;
      said.textContent = view.reading.join("\n");
      at.textContent = t("{time} · no. {n}", { time: clock(view.at), n: count(view.version) });
    }, { key: () => store.head?.cameras?.[name] }));
  }
  if (!shown.size) box.append(h("p", { className: "hx-hint" }, t("This plant has no calibration target.")));
  return () => off.forEach((end) => end());
}

// Flights of a drone: what became of each, and the errors that its rows share.
function flights(box) {
  const body = h("div"), file = h("input", { type: "file", accept: ".json,application/json", hidden: true });
  box.append(body, file);
  const shown = async () => {
    const rows = await api("GET", "flights");
    const shared = (r) => r.shared.map(([word, value, sigma]) => (word.endsWith(", m")
      ? `${word.slice(0, -3)} ${number(1e3 * value, 1)} ± ${number(1e3 * sigma, 1)} mm` : `${word.split(",")[0]} ${number(1e6 * value, 0)} ± ${number(1e6 * sigma, 0)} ppm`));
    body.replaceChildren(
      h("div", { className: "hx-row" }, h("h3", {}, t("Flights of a drone")),
        me.role === "engineer" ? h("button", { className: "hx-button", onclick: () => file.click() }, t("Take a flight…")) : ""),
      rows.length ? table([[t("Taken"), (r) => clock(r.at)], [t("Flight"), (r) => h("span", { title: shared(r).join("\n") }, r.name)], [t("By"), (r) => r.person],
        [t("Heliostats"), (r) => count(r.heliostats), "num"], [t("In use"), (r) => count(r.in_use), "num"],
        [t("At stow"), (r) => h("span", { title: t("Small changes, taken when the heliostat next stands at stow") }, count(r.at_stow)), "num"],
        [t("Photograph"), (r) => h("span", { title: t("Large changes and first calibrations, verified on a target first") }, count(r.at_target)), "num"],
        [t("Unchanged"), (r) => h("span", { className: r.unchanged ? "warn" : "", title: r.problems.join("\n") }, count(r.unchanged)), "num"],
        [t("Shared errors"), (r) => shared(r).slice(0, 3).join(", ")]], rows)
        : h("p", { className: "hx-hint" }, t("No flight has been taken.")));
  };
  file.onchange = () => act(async () => {
    const chosen = file.files[0];
    file.value = "";
    let document;
    try { document = JSON.parse(await chosen.text()); } catch { throw new Error(t("{name} is not a flight.json of drone evaluate", { name: chosen.name })); }
    await api("POST", "flights", document);
    await shown();
  }, t("flight"));
  return refreshed(shown, { every: 5 });
}

// What the plant predicted for this day, and what has come true since the first prediction.
const OUTLOOKS = ["LOCKED", "SEARCHING"], TRUE = "APPROACHING";
function outlookView(view, canvas, key) {
  if (!view.outlooks.length) return h("p", { className: "hx-hint" }, t("No prediction yet: it is made once calibration runs and half of the field is up."));
  const keys = view.outlooks.map((o, i) => [t("predicted at {time}, median", { time: clock(o.made).slice(0, 5) }), colourOf(OUTLOOKS[i])]);
  return h("div", { className: "hx-outlook" }, canvas, h("p", { className: "hx-keys" },
    [[t("came true, median"), colourOf(TRUE)], ...keys].flatMap(([text, colour]) => [key(text, colour), key(t("90th percentile"), colour, true)])),
  h("p", { className: "hx-hint" }, t("Predicted at {time}: {text}.", { time: clock(view.outlooks.at(-1).made).slice(0, 5), text: view.outlooks.at(-1).text })));
}

function outlookLines(view) {
  const since = view.outlooks[0].made - 1, came = view.field.filter((p) => p.at >= since);
  return [...view.outlooks.map((o, i) => [o.points, OUTLOOKS[i]]), [came, TRUE]].flatMap(([points, colour]) =>
    [["median"], ["percentile_90", [5, 4]]].map(([field, dash]) => ({ points: points.map((p) => [p.at, 1e3 * p[field]]), colour: colourOf(colour), dash })));
}

// What was learnt of each group of mirrors, and is in force.
function learning(box) {
  const body = h("div");
  box.append(body);
  const shown = async () => {
    const rows = await api("GET", "learning");
    const learn = (group) => act(async () => { await api("POST", "learning", { group }); await shown(); }, t("learn {group}", { group }));
    body.replaceChildren(h("h3", {}, t("Learnt at night")),
      table([[t("Group"), (r) => r.group], [t("Version"), (r) => (r.version ? h("span", { title: t("{n} photographs of {all} heliostats", { n: count(r.sightings), all: count(r.heliostats) }) }, `${r.version}, ${dayOf(r.at)} ${clock(r.at).slice(0, 5)}`) : t("defaults"))],
        [t("In force"), (r) => r.drift], ["", (r) => h("span", { className: "hx-hint" }, r.said)],
        ["", (r) => (me.role === "engineer" ? h("button", { className: "hx-button", onclick: () => learn(r.group) }, t("Learn now")) : "")]], rows));
  };
  return refreshed(shown, { every: 5 });
}

// The points since the plant's last pause of an hour, or all while these span less than two minutes.
function recent(points) {
  const begin = points.findLastIndex((p, i) => i > 0 && p.at - points[i - 1].at > 3600);
  return begin > 0 && points.at(-1).at - points[begin].at > 120 ? points.slice(begin) : points;
}

export function calibration(box) {
  const body = h("div"), lines = h("canvas", { className: "hx-chart" }), ahead = h("canvas", { className: "hx-chart" }), air = h("div"), nights = h("div");
  box.append(body, air, nights);
  const shown = new Set();
  let view = null, waiting = [];
  const draw = () => {
    if (!view) return;
    const quality = recent(view.quality), truth = quality.some((p) => p.truth_median !== null);
    const running = view.running.map((r) => h("li", {}, several([r.heliostat, ...r.others], r.target, shown), " ", t("on {target}: {stage}", { target: r.target, stage: r.stage }), h("em", {}, " ", t("since {time}", { time: clock(r.since) }))));
    const key = (text, colour, dashed) => h("span", {}, h("i", { className: dashed ? "dashed" : "", style: `color:${colour}` }), text);
    body.replaceChildren(
      h("div", { className: "hx-row" }, h("b", { className: view.on ? "good" : "warn" }, view.on ? t("Running") : t("Off: {reason}", { reason: view.reason })),
        canCommand() ? h("button", { className: "hx-button", onclick: () => act(() => api("PUT", "calibration", { on: !view.on }), t("calibration")) }, view.on ? t("Switch off") : t("Switch on")) : ""),
      facts([[t("Calibrated"), count(view.done)], [t("Waiting"), count(view.waiting)], [t("Failed"), count(view.failed)]]),
      h("ul", { className: "hx-list" }, running.length ? running : h("li", {}, t("no measurement in progress")), view.asked.length ? h("li", {}, t("asked for next:"), " ", several(view.asked, "", shown)) : ""),
      ...waiting.map((one) => waitingView(one)),
      h("h3", {}, t("Error of the calibrated heliostats (mrad)")), lines,
      h("p", { className: "hx-keys" }, key(t("predicted, median"), colourOf("APPROACHING")), key(t("90th percentile"), colourOf("APPROACHING"), true),
        truth ? [key(t("true (twin), median"), colourOf("SEARCHING")), key(t("90th percentile"), colourOf("SEARCHING"), true)] : ""),
      h("h3", {}, t("Error of all heliostats over the year (mrad), UTC")), outlookView(view, ahead, key),
      h("h3", {}, t("Last measurements")),
      !view.results.length ? h("p", { className: "hx-hint" }, t("None yet.")) : table([[t("Time"), (r) => clock(r.at)], [t("Heliostat"), (r) => r.heliostat], [t("Target"), (r) => r.target, "more"],
        [t("Before"), (r) => mrad(r.before), "num"], [t("After"), (r) => mrad(r.after), "num"], [t("Predicted"), (r) => mrad(r.predicted), "num"],
        ...(truth ? [[t("True before → after"), (r) => `${mrad(r.truth_before)} → ${mrad(r.truth_after)}`, "num"]] : []),
        ["", (r) => h("span", { className: r.outcome === "calibrated" ? "good" : "warn", title: r.text }, r.outcome === "calibrated" ? "✓" : r.text.split(";")[0])]], view.results.slice(0, 60), (r) => look(r.heliostat)));
    chart(lines, [["median", "APPROACHING"], ["percentile_90", "APPROACHING", [5, 4]], ["truth_median", "SEARCHING"], ["truth_percentile_90", "SEARCHING", [5, 4]]]
      .map(([field, colour, dash]) => ({ points: quality.filter((p) => p[field] !== null).map((p) => [p.at, 1e3 * p[field]]), colour: colourOf(colour), dash })), dark());
    if (view.outlooks.length) chart(ahead, outlookLines(view), dark());
  };
  const end = refreshed(async () => { [view, waiting] = await Promise.all([api("GET", "calibration"), waitingChanges()]); draw(); },
    { key: () => JSON.stringify([store.head?.calibration, store.head?.measuring, store.head?.changes]) });
  const off = store.on("theme", draw), landed = flights(air), learnt = learning(nights);
  return () => { end(); off(); landed(); learnt(); };
}

export function clusters(box) {
  const body = h("div");
  box.append(body);
  return refreshed(async () => {
    const rows = await api("GET", "clusters");
    const rank = (r) => (r.alive ? (r.live < r.heliostats ? 1 : 2) : 0);
    rows.sort((a, b) => rank(a) - rank(b) || a.name.localeCompare(b.name));
    body.replaceChildren(facts([[t("Heard"), t("{n} of {all}", { n: count(rows.filter((r) => r.alive).length), all: count(rows.length) })]]),
      table([[t("Cluster"), (r) => [h("b", {}, r.name), h("div", { className: r.alive ? (rank(r) === 2 ? "good" : "warn") : "bad" }, r.alive ? (rank(r) === 2 ? t("● healthy") : t("▲ degraded")) : t("✕ silent")),
        h("div", { className: "hx-hint" }, [r.acts.join(", "), r.problem].filter(Boolean).join("; "))]],
        [t("Heliostats"), (r) => `${r.live}/${r.heliostats}`, "num"], [t("Heard"), (r) => (r.age === null ? t("never") : `${number(r.age, 1)} s`), "num"],
        [t("Poll (ms)"), (r) => number(r.cycle === null ? null : 1e3 * r.cycle, 0), "most"], [t("Answered"), (r) => (r.answered === null ? "–" : `${number(100 * r.answered, 1)} %`), "num"],
        [t("Lease (s)"), (r) => number(r.lease_left, 1), "most"], [t("Clock"), (r) => r.time_quality], [t("Settings"), (r) => r.settings || t("not known")]],
      rows, (r) => { const place = store.field.clusters.indexOf(r.name); store.select(store.field.cluster.flatMap((c, row) => (c === place ? [row] : [])), -1); }));
  }, { every: 3 });
}

// One line for the alarms of many subjects that say the same of each.
function alike(rows) {
  const groups = new Map();
  for (const r of rows) {
    const text = r.subject ? r.text.replaceAll(r.subject, "each") : r.text;
    const like = [r.condition, r.active, r.acknowledged_by, text].join("\n");
    const group = groups.get(like);
    if (group) { group.rows.push(r); group.said = text; } else groups.set(like, { ...r, like, said: r.text, rows: [r] });
  }
  return [...groups.values()];
}

export function alarms(box) {
  const body = h("div"), shown = new Set();
  box.append(body);
  return refreshed(async () => {
    const rows = await api("GET", "alarms");
    const open = rows.filter((r) => !r.acknowledged_by);
    const acknowledge = async (those) => {
      const refused = [];
      for (const r of those) await api("POST", "alarms/acknowledge", { condition: r.condition, subject: r.subject }).catch((error) => refused.push(error.message));
      if (refused.length) throw new Error(those.length === 1 ? refused[0] : t("{n} of {all} refused: {why}", { n: count(refused.length), all: count(those.length), why: refused[0] }));
    };
    body.replaceChildren(h("div", { className: "hx-row" }, h("b", {}, t("{open} not acknowledged, {active} active", { open: count(open.length), active: count(rows.filter((r) => r.active).length) })),
      canCommand() && open.length ? h("button", { className: "hx-button", onclick: () => act(() => acknowledge(open), t("acknowledge all")) }, t("Acknowledge all")) : ""),
    rows.length ? table([["", (r) => h("span", { className: r.active ? (severe[r.severity] ?? "warn") : "" }, r.active ? (severe[r.severity] === "bad" ? "✕" : "▲") : "○")],
      [t("Time"), (r) => clock(r.at)], [t("What"), (r) => h("div", {}, h("b", {}, r.condition, r.subject ? " · " : ""), r.subject ? several(r.rows.map((one) => one.subject), r.like, shown) : "", h("div", { className: "hx-hint" }, r.said.replace(`${r.condition}: `, "")))],
      ["", (r) => (r.active ? t("active") : t("over"))],
      ["", (r) => (r.acknowledged_by ? `✓ ${r.acknowledged_by}` : canCommand() ? h("button", { className: "hx-button", onclick: () => act(() => acknowledge(r.rows), t("acknowledge")) }, t("Acknowledge")) : t("not acknowledged"))],
      ["×", (r) => r.rows.reduce((sum, one) => sum + one.count, 0), "num"]], alike(rows)) : h("p", { className: "hx-hint" }, t("No alarms.")));
  }, { key: () => store.head?.alarms, every: 4 });
}

// The text of an event; the names of its many heliostats are asked for when it is unfolded, and stay so.
const unfoldedEvents = new Map();
function eventText(r) {
  if (!r.heliostats) return r.text;
  const key = `${r.number} ${r.at}`, names = h("div", { className: "hx-hint" }, unfoldedEvents.get(key) ?? ""), box = h("details", { className: "hx-several", open: unfoldedEvents.has(key) },
    h("summary", { title: t("Show the {n} heliostats", { n: count(r.heliostats) }) }, r.text), names);
  box.ontoggle = async () => {
    if (!box.open) unfoldedEvents.delete(key);
    else if (!unfoldedEvents.has(key)) await act(async () => { names.textContent = (await api("GET", `events/${r.number}/heliostats`)).join(", "); unfoldedEvents.set(key, names.textContent); }, t("heliostats of the event"), false);
  };
  return box;
}

// The text of a command; what each heliostat does, or why it refused, when it is unfolded.
const unfoldedCommands = new Set();
function ticketText(r) {
  const kind = r.finished ? (r.good ? "good" : "warn") : "", each = Object.entries(r.refusals).concat(Object.entries(r.steps).filter(([name]) => !(name in r.refusals)));
  if (r.heliostats < 2 || !each.length) return h("span", { className: kind }, r.text);
  const reasons = new Map();
  for (const [name, why] of each) reasons.set(why, [...(reasons.get(why) ?? []), name]);
  const box = h("details", { className: "hx-several", open: unfoldedCommands.has(r.identity) }, h("summary", { className: kind, title: t("Show the {n} heliostats", { n: count(each.length) }) }, r.text),
    [...reasons].map(([why, names]) => h("div", { className: "hx-hint" }, `${names.join(", ")}: ${why}`)));
  box.ontoggle = () => (box.open ? unfoldedCommands.add(r.identity) : unfoldedCommands.delete(r.identity));
  return box;
}

export function logs(box) {
  let which = "events", filter = "";
  const body = h("div"), past = journal(), tabs = [word("events"), word("journal"), word("packets"), word("commands")].map((name) => h("button", { className: "hx-button", type: "button", value: name, onclick: () => { which = name; mark(); load(); } }, t(name)));
  const find = h("input", { type: "search", placeholder: t("filter"), oninput: () => { filter = find.value.toLowerCase(); load(); } });
  const mark = () => tabs.forEach((tab) => tab.classList.toggle("main", tab.value === which));
  const columns = {
    events: [[t("Time"), (r) => moment(r.at)], [t("Kind"), (r) => t(r.kind)], [t("Who"), (r) => r.who], ["", eventText]],
    packets: [[t("Time"), (r) => clock(r.at)], [t("Cluster"), (r) => `${r.way === "to" ? "→" : "←"} ${r.cluster}`], [t("Kind"), (r) => r.kind], [t("Bytes"), (r) => r.size, "num"], ["", (r) => h("code", {}, r.text)]],
    commands: [[t("Command"), (r) => r.command], [t("Heliostats"), (r) => count(r.heliostats), "num"], ["", (r) => ticketText(r)]],
  };
  const load = async () => {
    find.hidden = which === "journal";
    if (which === "journal") { if (!body.contains(past)) body.replaceChildren(past); return; }
    const rows = await api("GET", which === "commands" ? which : `${which}?limit=300`);
    const text = (r) => Object.values(r).join(" ").toLowerCase();
    body.replaceChildren(table(columns[which], filter ? rows.filter((r) => text(r).includes(filter)) : rows));
  };
  box.append(h("div", { className: "hx-row" }, tabs, find), body);
  mark();
  return refreshed(load, { key: () => store.head?.events, every: 3 });
}

// Events, alarms and commands of all days, from the store.
function journal() {
  const day = (back) => new Date(1e3 * (store.head.utc - 86400 * back)).toISOString().slice(0, 10);
  const field = (label, given) => { const input = h("input", given); return [h("label", { className: "hx-field" }, label, input), input]; };
  const [fromLabel, from] = field(t("From"), { type: "date", value: day(1) }), [toLabel, to] = field(t("To"), { type: "date", value: day(0) });
  const [whoLabel, who] = field(t("Person"), { type: "search", maxLength: 64 }), [nameLabel, name] = field(t("Heliostat"), { type: "search", maxLength: 64 });
  const [textLabel, text] = field(t("Text"), { type: "search", maxLength: 100 });
  const kind = h("select", { ariaLabel: t("Kind") }, [["", t("all kinds")], ["event", t("event")], ["alarm", t("alarm")], ["command", t("command")]].map(([value, text]) => h("option", { value }, text)));
  const all = h("input", { type: "checkbox" }), allLabel = h("label", { className: "hx-field" }, all, t("commands of automatic control too"));
  const found = h("div"), said = h("p", { className: "hx-hint" }, t("Events, alarms and commands of all days, over restarts.")), most = 1000;
  let rows = [];
  const unfolded = new Set();
  const search = async () => {
    const seconds = (date, more) => (date ? { [more ? "until" : "since"]: Date.parse(`${date}T00:00:00Z`) / 1e3 + (more ? 86400 : 0) } : {});
    const query = new URLSearchParams({ ...seconds(from.value, false), ...seconds(to.value, true), kind: kind.value, person: who.value.trim(), heliostat: name.value.trim(), text: text.value.trim(), but: all.checked ? "" : "automatic control", limit: most });
    rows = await api("GET", `journal?${query}`);
    said.textContent = rows.length === most ? t("The latest {n}; choose fewer days or a text.", { n: count(most) }) : t("{n} entries.", { n: count(rows.length) });
    found.replaceChildren(table([[t("Time (UTC)"), (r) => moment(r.at)], [t("Kind"), (r) => h("span", { className: severe[r.severity] ?? "" }, t(r.kind))], [t("What"), (r) => (r.kind === "event" ? t(r.what) : r.what)], ["", (r) => (r.heliostats.length ? h("span", {}, several(r.heliostats, `${r.at}${r.what}`, unfolded), " ", r.text) : r.text)]], rows));
  };
  const form = h("form", { className: "hx-row hx-search", onsubmit: (event) => { event.preventDefault(); act(search, t("journal"), false); } },
    fromLabel, toLabel, kind, whoLabel, nameLabel, textLabel, allLabel, h("button", { className: "hx-button main" }, t("Search")),
    h("button", { className: "hx-button", type: "button", onclick: () => saveCsv("journal.csv", ["time", "kind", "what", "text"], rows.map((r) => [new Date(1e3 * r.at).toISOString(), r.kind, r.what, r.text])) }, t("Save as CSV")));
  return h("div", {}, form, said, found);
}

const minute = (at) => (at ? `${monthDay(at)} ${clock(at).slice(0, 5)}` : "–");
const stateOf = (name) => h("span", { className: store.stateName(store.index.get(name)) === "STOWED" ? "good" : "bad" }, t(store.stateName(store.index.get(name))));
// What is locked: a heliostat by its bare name, else with its kind.
const lockedName = (one) => (one.kind === "tower" ? t("tower") : one.kind === "heliostat" ? one.name : `${t(one.kind)} ${one.name}`);
const places = (kind, name) => (kind === "tower" ? { tower: true } : { [`${kind}s`]: [name] });
// Each owner returns their own lock; an engineer can remove another owner's lock by naming the owner.
async function giveBack(one) {
  const own = one.who === me.name, name = lockedName(one);
  const v = own ? await ask(t("Return your lock on {name} ({reason})? Make sure that you and your tools are away.", { name, reason: one.reason }), [], t("Return lock"))
    : await ask(t("Remove the lock of {who} on {name} ({reason})? Make sure that {who} is not there.", { who: one.who, name, reason: one.reason }), [{ name: "reason", label: t("Why its owner cannot return it") }], t("Remove lock"));
  if (v) await act(() => api("POST", "holds/release", { ...places(one.kind, one.name), ...(own ? {} : { owner: one.who, reason: v.reason }) }), t("return the lock on {name}", { name }));
}
async function lockPlace() {
  const { targets, receivers } = store.field;
  const named = new Map([...targets.map((name) => [`${t("target")} ${name}`, ["target", name]]), ...receivers.map((name) => [`${t("receiver")} ${name}`, ["receiver", name]]), [t("tower"), ["tower", "tower"]]]);
  await askAnd(t("Lock a target, a receiver or the tower? Heliostats whose beams are aimed there stow, and none comes until everybody has returned their lock; under a locked tower all stow."), [
    { name: "place", label: t("Place"), options: [...named.keys()] }, { name: "reason", label: t("Reason") }, { name: "hours", label: t("Expected back in (hours)"), type: "number", value: "4", required: false }], t("Lock"),
  (v) => api("POST", "holds", { ...places(...named.get(v.place)), reason: v.reason, hours: Number(v.hours) || null }), t("lock"));
}

// The operator's own timetable: heliostats calibrated at times of day or at intervals.
const listed = (text) => text.split(",").map((one) => one.trim()).filter(Boolean);
async function putTimetable(entries, what) { await act(() => api("PUT", "timetable", { entries }), what); }
const asGiven = ({ name, heliostats, target, at, every_s, rule }) => ({ name, heliostats, target, at, every_s, rule });
const RULES = [["", t("at its times")], ["first", t("first: before others whenever a visit is worth it")], ["never", t("never: only persons calibrate them")]];
async function addEntry(rows) {
  await askAnd(t("Calibrate heliostats at times of day, at an interval, or both; or have automatic control take them first, or never?"), [
    { name: "name", label: t("Name of the entry") }, { name: "heliostats", label: t("Heliostats, separated by commas"), value: store.selected().slice(0, 200).join(", ") },
    { name: "rule", label: t("When"), options: RULES },
    { name: "target", label: t("Target"), options: [["", t("any")], ...store.field.targets] },
    { name: "at", label: t("Times of day with zone (08:30Z, 10:30+02:00)"), required: false },
    { name: "every", label: t("Interval from midnight UTC (minutes)"), type: "number", required: false }], t("Put in force"), (v) => {
    const entry = { name: v.name, heliostats: listed(v.heliostats), target: v.target, at: listed(v.at || ""), every_s: v.every ? 60 * Number(v.every) : null, rule: v.rule };
    return api("PUT", "timetable", { entries: [...rows.filter((one) => one.name !== v.name).map(asGiven), entry] });
  }, t("timetable"));
}
async function removeEntry(rows, name) {
  if (await ask(t("Remove {name} from the timetable? What it has asked for goes on.", { name }), [], t("Remove"))) await putTimetable(rows.filter((one) => one.name !== name).map(asGiven), t("remove {name} from the timetable", { name }));
}

export function schedule(box) {
  const body = h("div"), unfolded = new Set();
  box.append(body);
  return refreshed(async () => {
    const [plan, retries, holds, progress, timed] = await Promise.all([api("GET", "schedule?limit=50"), api("GET", "retries"), api("GET", "holds"), api("GET", "calibration"), api("GET", "timetable")]);
    body.replaceChildren(h("h3", {}, t("Next measurements")),
      progress.reason || progress.choice ? h("p", { className: "hx-hint" }, t("Automatic control: {text}", { text: progress.reason || progress.choice })) : "",
      plan.length ? table([[t("Time"), (r) => clock(r.at)], [t("Heliostat"), (r) => r.heliostat], [t("Target"), (r) => r.target], [t("Gain (mrad)"), (r) => mrad(r.gain), "num"], [t("Why"), (r) => r.reason]], plan, (r) => look(r.heliostat))
        : h("p", { className: "hx-hint" }, t("No measurement is planned.")),
      h("h3", {}, t("Timetable")),
      canCommand() ? h("button", { className: "hx-button", onclick: () => addEntry(timed) }, t("Calibrate at times, first or never…")) : "",
      timed.length ? table([[t("Entry"), (r) => r.name], [t("Heliostats"), (r) => several(r.heliostats, r.name, unfolded)], [t("Target"), (r) => r.target || t("any")],
        [t("When"), (r) => (r.rule ? t(r.rule) : [...r.at, ...(r.every_s ? [t("every {time}", { time: span(r.every_s) })] : [])].join(", "))], [t("Next"), (r) => minute(r.next)], [t("Last"), (r) => minute(r.last)], [t("Result"), (r) => r.text],
        ["", (r) => (canCommand() ? h("button", { className: "hx-button", onclick: () => removeEntry(timed, r.name) }, t("Remove…")) : "")]], timed)
        : h("p", { className: "hx-hint" }, t("Empty.")),
      h("h3", {}, t("Tried again, or given up ({n})", { n: count(retries.length) })),
      retries.length ? table([[t("Work"), (r) => r.work], [t("Of"), (r) => r.subject], [t("Failed"), (r) => t("{n} of {all}", { n: count(r.count), all: count(r.most) }), "num"], [t("Reason"), (r) => r.reason],
        [t("Next try"), (r) => h("span", { className: r.given_up ? "warn" : "" }, r.given_up ? t("given up") : "", " ", r.left === null ? "" : r.left > 0 ? t("in {time}", { time: span(r.left) }) : t("at the next turn"))],
        [t("Then"), (r) => r.following]], retries.slice(0, 100), (r) => look(r.subject))
        : h("p", { className: "hx-hint" }, t("Nothing.")),
      h("h3", {}, t("Out of service")),
      canCommand() ? h("button", { className: "hx-button", onclick: lockPlace }, t("Lock a target, receiver or the tower…")) : "",
      holds.length ? table([[t("Locked"), lockedName], [t("State"), (r) => (r.kind === "heliostat" ? stateOf(r.name) : "–")], [t("Owner"), (r) => r.who], [t("Since"), (r) => minute(r.since)],
        [t("Expected back"), (r) => h("span", { className: r.until && r.until < store.head.utc ? "warn" : "" }, r.until ? minute(r.until) : "–", r.until && r.until < store.head.utc ? ` ${t("overdue")}` : "")], [t("Why"), (r) => r.reason],
        ["", (r) => (r.who === me.name || me.role === "engineer" ? h("button", { className: "hx-button", onclick: () => giveBack(r) }, r.who === me.name ? t("Return lock…") : t("Remove lock…")) : "")]], holds, (r) => r.kind === "heliostat" && look(r.name))
        : h("p", { className: "hx-hint" }, t("None.")));
  }, { every: 5 });
}

