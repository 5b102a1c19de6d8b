// EMERGENCY: a script of its own, so that it works when everything else is slow or broken. One click or key press.
(() => {
  const button = document.getElementById("emergency");
  const say = document.getElementById("emergency-said");
  const word = document.querySelector('meta[name="heliotrope-csrf"]')?.content;
  let csrf = word;

  async function session() {
    const answer = await fetch("/api/v1/session", { credentials: "same-origin", cache: "no-store" });
    if (!answer.ok) throw new Error("sign in first");
    csrf = (await answer.json()).csrf;
  }

  async function call(again) {
    button.classList.add("sent");
    say.textContent = "sending …";
    try {
      if (!csrf) await session();
      const answer = await fetch("/api/v1/emergency", {
        method: "POST", credentials: "same-origin", keepalive: true,
        headers: { "X-CSRF-Token": csrf, "Content-Type": "application/json" },
        body: JSON.stringify({ act: "DEFOCUS", reason: "EMERGENCY button" }),
      });
      if (answer.status === 403 && again) { csrf = ""; return call(false); }
      const data = await answer.json();
      if (!answer.ok) throw new Error(data.detail);
      say.textContent = `ordered: ${data.act} of ${data.heliostats} heliostats`;
      setTimeout(() => { say.textContent = ""; button.classList.remove("sent"); }, 15000);
    } catch (error) {
      button.classList.remove("sent");
      say.textContent = `NOT SENT: ${error.message}. Use the hard-wired stop.`;
      say.classList.add("failed");
    }
  }

  button.addEventListener("click", () => call(true));
})();
