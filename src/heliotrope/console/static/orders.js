// The command bar: scope, command, result. Everything goes through the API.
import { api, me, store } from "./live.js";
import { ask, count, h } from "./dom.js";
import { t, word } from "./words.js";

export const AUTOMATIC = word("automatic control"); // as the plant names it

export const say = (text, bad) => store.emit("said", { text, bad });

// Runs an action and shows its result; one that is not `plain` says it itself.
export async function act(what, name, plain = true) {
  try {
    const done = await what();
    if (done?.identity) follow(done); else if (plain) say(t("{what}: done", { what: name }));
    return done;
  } catch (error) { say(`${name}: ${error.message}`, true); return null; }
}

// Asks, does it, and shows its result; after an error the form stays open with what was typed.
export async function askAnd(question, fields, confirm, what, name) {
  let done = null;
  const given = await ask(question, fields, confirm, async (values) => { done = await what(values); });
  if (given) await act(async () => done, name);
}

// Says how far a ticket is, to its end; a later one does not silence an earlier one's result.
let latest = "";
async function follow(ticket) {
  let seen = ticket;
  latest = ticket.identity;
  say(seen.text, seen.finished && !seen.good);
  for (let i = 0; !seen.finished; i++) {
    await new Promise((wake) => setTimeout(wake, i < 10 ? 700 : 3000));
    try { seen = await api("GET", `commands/${encodeURIComponent(ticket.identity)}`); } catch { return; }
    if (seen.finished || latest === ticket.identity) say(seen.text, seen.finished && !seen.good);
  }
}

// The commands by their meaning, always at the same places.
const GROUPS = [
  [word("Safe"), [word("Stow"), word("Defocus")]],
  [word("Move"), [word("Automatic"), word("Approach"), word("Track"), word("Standby"), word("Refocus"), word("Aim…")]],
  [word("Service"), [word("Lock"), word("Unlock"), word("Out of service…"), word("Search…"), word("Jog…"), word("Clear fault"), word("Zero…"), word("Lock position…")]],
];
let scope = "selection";

function recipients() {
  if (scope === "field") return { names: [], text: t("all {n} heliostats", { n: count(store.field.names.length) }) };
  let rows = [...store.selection];
  if (scope === "cluster") {
    const places = new Set(rows.map((row) => store.field.cluster[row]));
    rows = store.field.cluster.flatMap((c, row) => (places.has(c) ? [row] : []));
  }
  if (!rows.length) throw new Error(t("nothing selected: click a heliostat, draw a lasso or type a query"));
  const names = rows.map((row) => store.field.names[row]);
  return { names, text: names.length === 1 ? names[0] : t("{n} heliostats", { n: count(names.length) }) };
}

// EMERGENCY, DEFOCUS and STOW never ask; an order to the whole field asks once.
async function order(name, title, make, fields, sure) {
  let to;
  try { to = recipients(); } catch (error) { say(`${title}: ${error.message}`, true); return; }
  const safe = name === "STOW" || name === "DEFOCUS";
  if (fields || (!safe && (scope === "field" || (sure && to.names.length !== 1)))) {
    await askAnd(`${title}: ${to.text}`, fields ?? [], title, (values) => make(to.names, values), title);
  } else await act(() => make(to.names, {}), title);
}

// Declares the position of the axes: nothing moves, but every later motion depends on it.
async function zero() {
  const rows = [...store.selection];
  if (rows.length !== 1) { say(t("Zero: select exactly one heliostat; counts differ from one to the next"), true); return; }
  const name = store.field.names[rows[0]];
  await askAnd(t("Declare the position of {name}? It must be locked; its controller stores the counts.", { name }), [
    { name: "primary", label: t("Primary axis (steps)"), type: "number", value: "0" },
    { name: "secondary", label: t("Secondary axis (steps)"), type: "number", value: "0" }], t("Declare and store"),
  (v) => api("POST", "commands", { command: "ZERO", heliostats: [name], values: [Number(v.primary), Number(v.secondary)] }), t("Zero {name}", { name }));
}

// Declares that the beam is at its aim now: the counts become those that belong there.
async function lockPosition() {
  const rows = [...store.selection];
  if (rows.length !== 1) { say(t("Lock position: select exactly one heliostat"), true); return; }
  const name = store.field.names[rows[0]];
  const sure = await ask(t("Is the beam of {name} at its aim now? It must be locked. Its controller stores the step counts that belong there; nothing moves.", { name }), [], t("It is at its aim"));
  if (sure) await act(() => api("POST", "commands", { command: "LOCK_POSITION", heliostats: [name] }), t("Lock position {name}", { name }));
}

// At a receiver, a target, standby, or a point of the unrolled receiver (as the flux picture gives it).
export async function aim(where, right, up) {
  const places = [...store.field.receivers, ...store.field.targets], standby = t("standby"), at = (value) => (value === undefined ? "" : value.toFixed(2)); // what an input takes
  await order("AIM", t("Aim"), (heliostats, v) => {
    if (v.where === standby) return plainly("IDLE")(heliostats);
    const point = v.right || v.up ? { right: Number(v.right), up: Number(v.up) } : {};
    return api("POST", "aim", { heliostats, where: v.where, ...point });
  }, [{ name: "where", label: t("Place"), options: where ? [where] : [...places, standby] },
    { name: "right", label: t("On a receiver: right of its middle, seen from outside (m)"), type: "number", value: at(right), required: false },
    { name: "up", label: t("above its middle (m)"), type: "number", value: at(up), required: false }]);
}

const plainly = (name) => (heliostats) => api("POST", "commands", { command: name, heliostats });
const ORDERS = [
  [word("Stow"), "S", () => order("STOW", t("Stow"), (heliostats) => api("POST", "stow", { heliostats })), "safe"],
  [word("Defocus"), "D", () => order("DEFOCUS", t("Defocus"), (heliostats) => api("POST", "defocus", { heliostats })), "safe"],
  [word("Approach"), "", () => order("APPROACH", t("Approach"), plainly("APPROACH"), null, true)],
  [word("Track"), "", () => order("TRACK", t("Track"), plainly("TRACK"), null, true)],
  [word("Standby"), "", () => order("IDLE", t("Standby"), plainly("IDLE"))],
  [word("Refocus"), "", () => order("REFOCUS", t("Refocus"), plainly("REFOCUS"), null, true)],
  [word("Aim…"), "", () => aim()],
  [word("Jog…"), "", () => order("JOG", t("Jog"), (heliostats, v) => api("POST", "commands", { command: "JOG", heliostats, values: [v.axis === "primary" ? 0 : 1, Number(v.steps)] }),
    [{ name: "axis", label: t("Axis"), options: [["primary", t("primary")], ["secondary", t("secondary")]] }, { name: "steps", label: t("Steps (up and east positive)"), type: "number", value: "100" }]), "engineer"],
  [word("Lock"), "", () => order("LOCK", t("Lock"), plainly("LOCK"))],
  [word("Unlock"), "", () => order("UNLOCK", t("Unlock"), plainly("UNLOCK"))],
  [word("Search…"), "", () => order("SEARCH", t("Search"), (heliostats, v) => api("POST", "commands", { command: "SEARCH", heliostats, values: [1e-3 * v.pitch, 1e-3 * v.radius] }),
    [{ name: "pitch", label: t("Pitch (mrad)"), type: "number", value: "5" }, { name: "radius", label: t("Radius (mrad)"), type: "number", value: "30" }])],
  [word("Clear fault"), "", () => order("CLEAR_FAULT", t("Clear fault"), plainly("CLEAR_FAULT")), "engineer"],
  [word("Zero…"), "", zero, "engineer"],
  [word("Lock position…"), "", lockPosition, "engineer"],
  [word("Out of service…"), "", () => order("HOLD", t("Out of service"), (heliostats, v) => api("POST", "holds", { heliostats: heliostats.length ? heliostats : store.field.names, reason: v.reason, hours: Number(v.hours) || null }),
    [{ name: "reason", label: t("Reason: it goes to stow, and nobody moves it until it is given back by name") }, { name: "hours", label: t("Expected back in (hours)"), type: "number", value: "4", required: false }]), "free"],
  [word("Automatic"), "", () => order("AUTO", t("Give to automatic control"), (heliostats) => api("POST", "automatic", { heliostats }), null, true), "free"],
];

export function bar(box) {
  const said = h("div", { className: "hx-said", role: "status" }), unfold = h("button", { type: "button", className: "hx-button hx-unfold", hidden: true, ariaLabel: t("Whole text") }, "…"), line = h("div", { className: "hx-line" }, said, unfold);
  if (me.role === "viewer") {
    box.append(h("span", { className: "hx-hint" }, t("View only. EMERGENCY is open to everybody.")), line);
  } else {
    const to = h("select", { title: t("Scope (T)"), onchange: () => { scope = to.value; mark(); } },
      h("option", { value: "selection" }, t("Selection")), h("option", { value: "cluster" }, t("Clusters of the selection")), h("option", { value: "field" }, t("Whole field")));
    const buttons = ORDERS.filter(([, , , kind]) => kind !== "engineer" || me.role === "engineer")
      .map(([title, key, go, kind]) => [h("button", { className: `hx-button ${kind === "safe" ? "safe" : ""}`, title: key ? `Alt+${key}` : "", onclick: go }, t(title)), kind, title]);
    const groups = GROUPS.map(([name, titles]) => h("span", { className: "hx-group", role: "group", ariaLabel: t(name) }, h("em", {}, t(name)),
      buttons.filter(([, , title]) => titles.includes(title)).map(([button]) => button)));
    const mark = () => {
      const n = store.selection.size;
      to.options[0].textContent = t("Selection ({n})", { n: count(n) });
      for (const [button, kind] of buttons) {
        const may = kind === "safe" || kind === "free" || store.mine;
        button.disabled = !store.field || !may || (scope !== "field" && !n);
      }
    };
    box.append(h("div", { className: "hx-orders" }, h("label", { className: "hx-to" }, t("Scope"), " ", to), groups), line);
    // The whole field, or whole clusters, must be chosen anew after each selection.
    store.on("selection", () => { if (store.selection.size) scope = to.value = "selection"; mark(); });
    store.on("authority", mark);
    store.on("field", mark);
    document.addEventListener("keydown", (event) => {
      const found = event.altKey && ORDERS.find(([, key]) => key && event.code === `Key${key}`);
      if (found) { event.preventDefault(); found[2](); }
    });
    mark();
  }
  // A text that is cut is unfolded above the bar by a press, a touch or a key; it stays so while longer ones follow.
  const whole = (open) => { said.classList.toggle("whole", open); unfold.ariaExpanded = open; };
  const fit = () => {
    const open = said.classList.contains("whole");
    whole(false);
    unfold.hidden = true;
    unfold.hidden = said.scrollWidth <= said.clientWidth;
    whole(open && !unfold.hidden);
  };
  unfold.onclick = () => whole(!said.classList.contains("whole"));
  said.onclick = () => { if (!unfold.hidden) whole(true); };
  line.onkeydown = ({ key }) => { if (key === "Escape") whole(false); };
  new ResizeObserver(fit).observe(line);
  store.on("said", ({ text, bad }) => { said.textContent = text; said.title = text; said.classList.toggle("bad", Boolean(bad)); fit(); });
}

// The holder of the authority, and the button to take it and give it back.
export function whoCommands(box) {
  const text = h("span"), button = h("button", { className: "hx-button" }, t("Take command"));
  box.append(text, me.role === "viewer" ? "" : button);
  const take = async () => {
    const head = store.head;
    const change = (method, path, body) => act(() => api(method, path, body), t("authority"), false); // the button shows the result
    if (store.mine) return change("DELETE", "authority");
    const other = head.holder && head.holder !== me.name && head.holder !== AUTOMATIC;
    if (!other) return change("POST", "authority");
    const why = await ask(t("{who} has command. Break it?", { who: head.holder }), [{ name: "reason", label: t("Reason") }], t("Break and take"));
    return why ? change("POST", "authority/seize", { reason: why.reason }) : null;
  };
  button.addEventListener("click", async () => { await take(); kept = 0; });
  let kept = 0;
  const show = (head) => {
    const mine = head.holder === me.name && head.role === me.role;
    if (mine !== store.mine) { store.mine = mine; store.emit("authority", mine); }
    text.textContent = mine ? t("You have command") : head.holder ? t("{who} has command", { who: head.holder === AUTOMATIC ? t(AUTOMATIC) : head.holder }) : t("Nobody has command");
    text.className = mine ? "good" : "";
    button.textContent = mine ? t("Release") : t("Take command");
    // Renewed only while this page is visible.
    if (mine && !document.hidden && performance.now() - kept > 4000) {
      kept = performance.now();
      api("PUT", "authority").catch(() => {});
    }
  };
  store.on("frame", show);
}
