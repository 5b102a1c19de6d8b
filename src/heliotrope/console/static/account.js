// The page of one's own account, which does without the frame: who owes something sees only this one.
(() => {
  let t = (text) => text; // English until the catalogue is there
  const words = import("./words.js").then((found) => { t = found.t; }).catch(() => {});
  const word = (text) => text;
  const find = (id) => document.getElementById(id);
  const csrf = document.querySelector('meta[name="heliotrope-csrf"]').content;
  const DUE = {
    password: word("Somebody else knows this password. Change it before you go on."),
    factor: word("Your role needs a second factor. Set it up before you go on."),
  };

  async function api(method, path, body) {
    const headers = { "X-CSRF-Token": csrf };
    const options = { method, headers, credentials: "same-origin", cache: "no-store" };
    if (body !== undefined) {
      options.body = JSON.stringify(body);
      headers["Content-Type"] = "application/json";
    }
    const answer = await fetch(`/api/v1/${path}`, options);
    if (answer.status === 401) { location.assign("/login"); throw new Error(t("signed out")); }
    const data = answer.status === 204 ? null : await answer.json();
    if (!answer.ok) throw new Error(typeof data.detail === "string" ? data.detail : data.detail.map((one) => one.msg).join("; "));
    return data;
  }

  // Does the work of a form; what goes wrong is told in it.
  function on(name, work) {
    const form = find(name), said = form.querySelector("[role=alert]");
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      said.textContent = "";
      try { await work(Object.fromEntries(new FormData(form))); } catch (error) { said.textContent = error.message; }
    });
  }

  on("password", async (given) => {
    if (given.new !== given.again) throw new Error(t("the two new passwords differ; nothing was changed"));
    await api("PUT", "session/password", { old: given.old ?? "", new: given.new });
    location.assign("/login");
  });
  on("begin", async (given) => {
    const made = await api("POST", "session/factor", given);
    find("qr").src = made.qr;
    find("secret").textContent = made.secret.match(/.{1,4}/g).join(" ");
    find("begin").hidden = true;
    find("confirm").hidden = false;
    find("confirm").elements.code.focus();
  });
  on("confirm", async (given) => {
    const { codes } = await api("PUT", "session/factor", given);
    find("confirm").hidden = true;
    find("codes").hidden = false;
    find("codes").querySelector("pre").textContent = codes.join("\n");
    find("due").textContent = "";
  });
  on("remove", async (given) => {
    await api("DELETE", "session/factor", given);
    await look();
  });
  find("leave").addEventListener("click", async () => {
    try { await api("DELETE", "session"); } finally { location.assign("/login"); }
  });

  async function look() {
    const who = await api("GET", "session");
    find("due").textContent = who.owes in DUE ? t(DUE[who.owes]) : "";
    find("limits").textContent = [
      t("A session ends after {hours} h.", { hours: who.session_hours }),
      ...who.idle_minutes ? [t("After {minutes} min without a command, the next one needs your password.", { minutes: who.idle_minutes })] : [],
      t("After {count} failed sign-ins in an hour, the next one waits.", { count: who.sign_ins_per_hour }),
    ].join(" ");
    find("password").hidden = who.owes === "factor";
    find("old").hidden = find("password").elements.old.disabled = who.no_password;
    find("factor").hidden = who.owes === "password";
    find("begin").hidden = who.factor;
    find("remove").hidden = !who.factor;
  }
  words.then(look).catch(() => {});
})();
