// EMERGENCY: a script of its own, so that it works when everything else is slow or broken. One click, one touch, or Alt+E.
(() => {
  // English until the catalogue is there: nothing here waits for it.
  let t = (text, values = {}) => text.replace(/\{(\w+)\}/g, (whole, name) => values[name]);
  import("./words.js").then((words) => { t = words.t; }).catch(() => {});
  const button = document.getElementById("emergency");
  const say = document.getElementById("emergency-said");
  const meta = (name) => document.querySelector(`meta[name="heliotrope-${name}"]`)?.content;
  let csrf = meta("csrf");
  const port = Number(meta("emergency"));

  async function session() {
    const answer = await fetch("/api/v1/session", { credentials: "same-origin", cache: "no-store" });
    if (!answer.ok) throw new Error(t("sign in first"));
    csrf = (await answer.json()).csrf;
  }

  async function send(where, given) {
    const answer = await fetch(where, { method: "POST", keepalive: true, signal: AbortSignal.timeout(15000), ...given });
    // A proxy, or a program that has failed, answers without JSON.
    const data = await answer.json().catch(() => { throw Object.assign(new Error(t("the console answered with error {status}", { status: answer.status })), { status: answer.status }); });
    if (!answer.ok) throw Object.assign(new Error(data.detail), { status: answer.status });
    return data;
  }

  // The same order by the ordinary way and by the one that serves nothing else; the plant gets it once, by its word.
  function ways() {
    const order = { act: "DEFOCUS", reason: "EMERGENCY button", call: `${Date.now()}-${Math.random()}` };
    const found = [send("/api/v1/emergency", {
      credentials: "same-origin", headers: { "X-CSRF-Token": csrf, "Content-Type": "application/json" }, body: JSON.stringify(order),
    })];
    // As text, so that the browser sends it at once, without asking first.
    if (port) found.push(send(`${location.protocol}//${location.hostname}:${port}/api/v1/emergency`, {
      credentials: "include", headers: { "Content-Type": "text/plain" }, body: JSON.stringify({ ...order, csrf }),
    }));
    return found;
  }

  async function call(again) {
    button.classList.add("sent");
    say.classList.remove("failed");
    say.textContent = t("sending …");
    try {
      if (!csrf) await session();
      const data = await Promise.any(ways()).catch((errors) => { throw errors.errors[0]; });
      say.textContent = t("ordered: {act} of {n} heliostats", { act: t(data.act), n: data.heliostats });
      setTimeout(() => { say.textContent = ""; button.classList.remove("sent"); }, 15000);
    } catch (error) {
      if (error.status === 403 && again) { csrf = ""; return call(false); }
      button.classList.remove("sent");
      say.textContent = t("NOT SENT: {error}. Use the hard-wired stop.", { error: error.message });
      say.classList.add("failed");
    }
  }

  let touched = -Infinity;
  // A touch counts by itself: whatever it closes may swallow its click.
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
