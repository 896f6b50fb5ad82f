// The entrance of a server: exchanges the ticket of an address, behind #, for a session.

const told = /** @type {HTMLElement} */ (document.getElementById("vtb-entrance"));

async function enter() {
  const ticket = location.hash.slice(1);
  if (!ticket) return;
  history.replaceState(null, "", location.pathname + location.search); // It is not kept in the history.
  const answer = await fetch("enter", { method: "POST", body: ticket }).catch(() => null);
  const text = answer ? await answer.text().catch(() => "") : "the server has ended: start it again";
  if (answer?.ok) location.replace(text);
  else told.textContent = `Refused: ${text}.`;
}

addEventListener("hashchange", enter); // Another address was typed over this one.
await enter();
