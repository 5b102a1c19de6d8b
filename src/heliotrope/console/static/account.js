// The page of one's own account, which does without the frame: who owes a change of password sees only this one.
(() => {
  const find = (id) => document.getElementById(id);
  const csrf = document.querySelector('meta[name="heliotrope-csrf"]').content;
  const DUE = { password: "Somebody else knows this password. Change it before you go on." };

  async function api(method, path, body) {
    const headers = { "X-CSRF-Token": csrf };
    const options = { method, headers, credentials: "same-origin", cache: "no-store" };
    if (body !== undefined) {
      options.body = JSON.stringify(body);
      headers["Content-Type"] = "application/json";
    }
    const answer = await fetch(`/api/v1/${path}`, options);
    if (answer.status === 401) { location.assign("/login"); throw new Error("signed out"); }
    const data = answer.status === 204 ? null : await answer.json();
    if (!answer.ok) throw new Error(typeof data.detail === "string" ? data.detail : data.detail.map((one) => one.msg).join("; "));
    return data;
  }

  // Does the work of a form; what goes wrong is told in it.
  function on(form, said, work) {
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      said.textContent = "";
      try { await work(Object.fromEntries(new FormData(form))); } catch (error) { said.textContent = error.message; }
    });
  }

  on(find("password"), find("said"), async (given) => {
    if (given.new !== given.again) throw new Error("the two new passwords differ; nothing was changed");
    await api("PUT", "session/password", { old: given.old, new: given.new });
    location.assign("/login");
  });
  find("leave").addEventListener("click", async () => {
    try { await api("DELETE", "session"); } finally { location.assign("/login"); }
  });
  api("GET", "session").then((who) => { find("due").textContent = DUE[who.owes] ?? ""; }, () => {});
})();
