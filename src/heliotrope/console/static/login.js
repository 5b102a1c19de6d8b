// Heard from the first moment on: what is typed early must not go into the address. The words come when they can.
const words = import("./words.js");
document.getElementById("login").addEventListener("submit", async (event) => {
  event.preventDefault();
  const said = document.getElementById("said"), form = new FormData(event.target);
  said.textContent = "";
  try {
    const answer = await fetch("/api/v1/session", {
      method: "POST", headers: { "Content-Type": "application/json" }, credentials: "same-origin",
      body: JSON.stringify({ name: form.get("name"), password: form.get("password"), code: form.get("code") }),
    });
    if (answer.ok) location.assign("/");
    else if (answer.status === 428) {
      document.getElementById("code").hidden = false;
      event.target.elements.code.focus();
      said.textContent = (await answer.json()).detail;
    } else said.textContent = (await answer.json()).detail;
  } catch {
    said.textContent = (await words).t("the console does not answer");
  }
});
