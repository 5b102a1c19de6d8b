// Accounts and tokens: in windows over the page, since they are rarely needed. Everything goes through the API.
import { api, me } from "./live.js";
import { ask, h, lay, table } from "./dom.js";
import { say } from "./orders.js";

const day = (at) => (at ? new Date(1e3 * at).toISOString().slice(0, 10) : "never");
const button = (text, onclick) => h("button", { type: "button", className: "hx-button", onclick }, text);

// A window that redraws its contents after each action in it.
function open(title, fill) {
  const body = h("div"), told = h("p", { className: "hx-told", role: "status" });
  const dialog = h("dialog", { className: "hx-dialog wide" }, h("h2", {}, title), body, told,
    h("div", { className: "hx-row" }, button("Close", () => dialog.close())));
  const show = async () => body.replaceChildren(...await fill(done));
  const fail = (error) => { told.textContent = error.message; told.classList.add("bad"); };
  async function done(work) {
    told.classList.remove("bad");
    told.textContent = "";
    try {
      const said = await work();
      body.inert = true;  // a click into rows that are about to be replaced would be lost
      told.replaceChildren(...[said].flat().filter(Boolean));
      await show();
    } catch (error) { fail(error); } finally { body.inert = false; }
  }
  lay(dialog);
  show().catch(fail);
}

// Asks for one's own password, and other things: a change of accounts or tokens needs it. Null: cancelled.
const OWN = { name: "own_password", label: "Your own password", type: "password" };
const confirmed = (title, fields, confirm) => ask(title, [...fields, OWN], confirm);

const once = (what, word) => [`${what}, shown only now: `, h("code", { className: "hx-secret" }, word)];
const path = (name) => `accounts/${encodeURIComponent(name)}`;
const ROLES = ["viewer", "operator", "engineer"];

export const people = () => open("People", async (done) => {
  const rows = await api("GET", "accounts");
  const role = (one) => (one.name === me.name ? one.role
    : h("select", { "aria-label": `Role of ${one.name}`, onchange: (event) => done(async () => {
      const chosen = event.target.value, given = await confirmed(`Make ${one.name} ${chosen}?`, [], "Change");
      if (!given) return "";
      await api("PATCH", path(one.name), { role: chosen, ...given });
      return `${one.name}: ${chosen}`;
    }) },
      ROLES.map((name) => h("option", { value: name, selected: name === one.role }, name))));
  const acts = (one) => (one.name === me.name ? h("span", { className: "hx-hint" }, "you") : h("div", { className: "hx-orders" },
    button(one.disabled ? "Enable" : "Disable", () => done(async () => {
      const given = await confirmed(one.disabled ? `Enable ${one.name}?` : `Disable ${one.name}? Sessions and tokens end.`, [], one.disabled ? "Enable" : "Disable");
      if (!given) return "";
      await api("PATCH", path(one.name), { disabled: !one.disabled, ...given });
      return `${one.name} is ${one.disabled ? "enabled" : "disabled"}`;
    })),
    button("New password", () => done(async () => {
      const given = await confirmed(`Create a new password for ${one.name}? The old password, all sessions and tokens end.`, [], "Create");
      return given ? once(`New password of ${one.name}`, (await api("POST", `${path(one.name)}/password`, given)).password) : "";
    })),
    one.factor && button("Remove second factor", () => done(async () => {
      const given = await confirmed(`Remove the second factor of ${one.name}? All sessions end.`,
        [{ name: "own_code", label: "Code of your own second factor" }], "Remove");
      if (!given) return "";
      await api("DELETE", `${path(one.name)}/factor`, given);
      return `${one.name} has no second factor`;
    }))));
  const add = button("Add…", () => done(async () => {
    const given = await confirmed("New account", [{ name: "name", label: "Name" }, { name: "role", label: "Role", options: ROLES },
      { name: "password", label: "Password (at least 10 characters)", type: "password" }], "Create account");
    if (!given) return "";
    await api("POST", "accounts", given);
    return `account ${given.name} created, ${given.role}`;
  }));
  return [table([["Name", (r) => r.name], ["Role", role], ["Since", (r) => day(r.created)],
    ["", (r) => h("span", { className: r.disabled ? "warn" : "good" }, r.disabled ? "disabled" : "enabled")], ["", acts]], rows), h("div", { className: "hx-row" }, add)];
});

export const tokens = () => open("API tokens", async (done) => {
  const rows = await api("GET", "tokens");
  const revoke = (one) => button("Revoke", () => done(async () => {
    const given = await confirmed(`Revoke ${one.label} of ${one.name}? Programs that use it are refused at once.`, [], "Revoke");
    if (!given) return "";
    await api("DELETE", `tokens/${encodeURIComponent(one.key)}`, given);
    return `${one.label} is revoked`;
  }));
  const make = button("Create…", () => done(async () => {
    const given = await confirmed("New token for a program: it ends with your password; at most 90 days, for a viewer 365", [{ name: "label", label: "Purpose" },
      { name: "role", label: "Role", options: ROLES.slice(0, ROLES.indexOf(me.role) + 1) }, { name: "days", label: "Days", type: "number", value: "30" }], "Create");
    return given ? once(`Secret of ${given.label}`, (await api("POST", "tokens", { ...given, days: Number(given.days) })).secret) : "";
  }));
  return [rows.length ? table([["Purpose", (r) => r.label], ["Owner", (r) => r.name], ["Role", (r) => r.role], ["Ends", (r) => day(r.expires)],
    ["Last used", (r) => day(r.last_used)], ["", revoke]], rows) : h("p", { className: "hx-hint" }, "No tokens."), h("div", { className: "hx-row" }, make)];
});

export async function password() {
  const { no_password: first } = await api("GET", "session");
  const old = first ? [] : [{ name: "old", label: "Current password", type: "password" }];
  const given = await ask(`${first ? "Set" : "Change"} your password; you sign in again afterwards`, [...old,
    { name: "new", label: "New password (at least 10 characters)", type: "password" }, { name: "again", label: "New password again", type: "password" }], first ? "Set" : "Change");
  if (!given) return;
  if (given.new !== given.again) { say("password: the two new passwords differ; nothing was changed", true); return; }
  try {
    await api("PUT", "session/password", { old: given.old ?? "", new: given.new });
    location.assign("/login");
  } catch (error) { say(`password: ${error.message}`, true); }
}
