// EMERGENCY: a script of its own, so that it works when everything else is slow or broken. One click, one touch, or Alt+E.
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
    say.classList.remove("failed");
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

  let touched = -Infinity;
  // An open menu swallows the click of the touch that closes it, but not the touch itself.
  button.addEventListener("pointerup", (event) => { if (event.pointerType !== "mouse") { touched = event.timeStamp; call(true); } });
  button.addEventListener("click", (event) => { if (event.timeStamp - touched > 1000) call(true); });
  // Before anything else on the page hears the key; AltGr, which reports Ctrl too, is for writing.
  window.addEventListener("keydown", (event) => {
    if (!event.altKey || event.ctrlKey || event.metaKey || event.repeat || event.code !== "KeyE") return;
    event.preventDefault();
    event.stopImmediatePropagation();
    call(true);
  }, true);
})();
