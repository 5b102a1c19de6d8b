// Accounts and tokens: in windows over the page, since they are rarely needed. Everything goes through the API.
import { api, me } from "./live.js";
import { ask, h, lay, table } from "./dom.js";
import { say } from "./orders.js";
import { day as dayOf, t, word } from "./words.js";

const day = (at) => (at ? dayOf(at) : t("never"));
const button = (text, onclick) => h("button", { type: "button", className: "hx-button", onclick }, text);

// A window that redraws its contents after each action in it.
function open(title, fill) {
  const body = h("div"), told = h("p", { className: "hx-told", role: "status" });
  const dialog = h("dialog", { className: "hx-dialog wide" }, h("h2", {}, title), body, told,
    h("div", { className: "hx-row" }, button(t("Close"), () => dialog.close())));
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
const OWN = { name: "own_password", label: t("Your own password"), type: "password" };
const confirmed = (title, fields, confirm) => ask(title, [...fields, OWN], confirm);

const once = (what, word) => [`${what} `, h("code", { className: "hx-secret" }, word)];
const path = (name) => `accounts/${encodeURIComponent(name)}`;
const ROLES = [word("viewer"), word("operator"), word("engineer")], choices = (names) => names.map((name) => [name, t(name)]);

export const people = () => open(t("People"), async (done) => {
  const rows = await api("GET", "accounts");
  const role = (one) => (one.name === me.name ? t(one.role)
    : h("select", { "aria-label": t("Role of {name}", { name: one.name }), onchange: (event) => done(async () => {
      const chosen = event.target.value, given = await confirmed(t("Make {name} {role}?", { name: one.name, role: t(chosen) }), [], t("Change"));
      if (!given) return "";
      await api("PATCH", path(one.name), { role: chosen, ...given });
      return `${one.name}: ${t(chosen)}`;
    }) },
      ROLES.map((name) => h("option", { value: name, selected: name === one.role }, t(name)))));
  const acts = (one) => (one.name === me.name ? h("span", { className: "hx-hint" }, t("you")) : h("div", { className: "hx-orders" },
    button(one.disabled ? t("Enable") : t("Disable"), () => done(async () => {
      const given = await confirmed(one.disabled ? t("Enable {name}?", { name: one.name }) : t("Disable {name}? Sessions and tokens end.", { name: one.name }), [], one.disabled ? t("Enable") : t("Disable"));
      if (!given) return "";
      await api("PATCH", path(one.name), { disabled: !one.disabled, ...given });
      return one.disabled ? t("{name} is enabled", { name: one.name }) : t("{name} is disabled", { name: one.name });
    })),
    button(t("New password"), () => done(async () => {
      const given = await confirmed(t("Create a new password for {name}? The old password, all sessions and tokens end.", { name: one.name }), [], t("Create"));
      return given ? once(t("New password of {name}, shown only now:", { name: one.name }), (await api("POST", `${path(one.name)}/password`, given)).password) : "";
    })),
    one.factor && button(t("Remove second factor"), () => done(async () => {
      const given = await confirmed(t("Remove the second factor of {name}? All sessions end.", { name: one.name }),
        [{ name: "own_code", label: t("Code of your own second factor") }], t("Remove"));
      if (!given) return "";
      await api("DELETE", `${path(one.name)}/factor`, given);
      return t("{name} has no second factor", { name: one.name });
    }))));
  const add = button(t("Add…"), () => done(async () => {
    const given = await confirmed(t("New account"), [{ name: "name", label: t("Name") }, { name: "role", label: t("Role"), options: choices(ROLES) },
      { name: "password", label: t("Password (at least 10 characters)"), type: "password" }], t("Create account"));
    if (!given) return "";
    await api("POST", "accounts", given);
    return t("account {name} created, {role}", { name: given.name, role: t(given.role) });
  }));
  return [table([[t("Name"), (r) => r.name], [t("Role"), role], [t("Since"), (r) => day(r.created)],
    ["", (r) => h("span", { className: r.disabled ? "warn" : "good" }, r.disabled ? t("disabled") : t("enabled"))], ["", acts]], rows), h("div", { className: "hx-row" }, add)];
});

export const tokens = () => open(t("API tokens"), async (done) => {
  const rows = await api("GET", "tokens");
  const revoke = (one) => button(t("Revoke"), () => done(async () => {
    const given = await confirmed(t("Revoke {label} of {name}? Programs that use it are refused at once.", { label: one.label, name: one.name }), [], t("Revoke"));
    if (!given) return "";
    await api("DELETE", `tokens/${encodeURIComponent(one.key)}`, given);
    return t("{label} is revoked", { label: one.label });
  }));
  const make = button(t("Create…"), () => done(async () => {
    const given = await confirmed(t("New token for a program: it ends with your password; at most 90 days, for a viewer 365"), [{ name: "label", label: t("Purpose") },
      { name: "role", label: t("Role"), options: choices(ROLES.slice(0, ROLES.indexOf(me.role) + 1)) }, { name: "days", label: t("Days"), type: "number", value: "30" }], t("Create"));
    return given ? once(t("Secret of {label}, shown only now:", { label: given.label }), (await api("POST", "tokens", { ...given, days: Number(given.days) })).secret) : "";
  }));
  return [rows.length ? table([[t("Purpose"), (r) => r.label], [t("Owner"), (r) => r.name], [t("Role"), (r) => t(r.role)], [t("Ends"), (r) => day(r.expires)],
    [t("Last used"), (r) => day(r.last_used)], ["", revoke]], rows) : h("p", { className: "hx-hint" }, t("No tokens.")), h("div", { className: "hx-row" }, make)];
});

export async function password() {
  const { no_password: first } = await api("GET", "session");
  const old = first ? [] : [{ name: "old", label: t("Current password"), type: "password" }];
  const given = await ask(first ? t("Set your password; you sign in again afterwards") : t("Change your password; you sign in again afterwards"), [...old,
    { name: "new", label: t("New password (at least 10 characters)"), type: "password" }, { name: "again", label: t("New password again"), type: "password" }], first ? t("Set") : t("Change"));
  if (!given) return;
  if (given.new !== given.again) { say(t("the two new passwords differ; nothing was changed"), true); return; }
  try {
    await api("PUT", "session/password", { old: given.old ?? "", new: given.new });
    location.assign("/login");
  } catch (error) { say(`${t("password")}: ${error.message}`, true); }
}
