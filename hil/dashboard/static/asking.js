// What is asked of a run: a sign at once at the button, and a clear word when it was not taken.

const ANSWERED_WITHIN_MS = 3000;
const READ_WITHIN_MS = 700; // nobody has read and understood a question before
const held = new WeakMap();

// Setting a text that is there already would have screen readers say it again.
export function setText(element, text) {
  if (element && element.textContent !== text) element.textContent = text;
}

function say(form, said, refused = "") {
  setText(form.querySelector(".said"), said);
  setText(form.querySelector(".refused"), refused);
}

function setHeld(form, yes) {
  clearTimeout(held.get(form));
  for (const button of form.querySelectorAll("button")) button.setAttribute("aria-disabled", String(yes));
}

// No answer is taken for a moment; aria-disabled, for a button that is disabled loses the focus.
export function hold(form, for_ms = READ_WITHIN_MS) {
  setHeld(form, true);
  held.set(form, setTimeout(() => setHeld(form, "over" in (form.closest("#run")?.dataset || {})), for_ms));
}

function refused(form, button, why, how = "was NOT accepted") {
  const name = (button?.firstChild.textContent || "This").trim();
  const stops = button?.matches(".stop, [value=no]");
  say(form, "", `“${name}” ${how}: ${why}${stops ? ": use the robot’s own button" : ""}.`);
}

async function ask(form, button) {
  const answers = Boolean(button?.name);
  const body = new URLSearchParams(new FormData(form, button));
  say(form, button?.matches(".stop") ? "stopping …" : "sending …");
  if (answers) hold(form, 2 * ANSWERED_WITHIN_MS); // until the next question, or none is taken
  try {
    const signal = AbortSignal.timeout(ANSWERED_WITHIN_MS);
    const answer = await fetch(form.action, { method: "POST", body, signal, headers: { Accept: "application/json" } });
    const told = await answer.json().catch(() => ({ error: `${answer.status} ${answer.statusText}` }));
    if (answer.ok) return void say(form, `requested: ${told.asked}`);
    refused(form, button, [told.error, told.hint].filter(Boolean).join(" → "));
  } catch (error) {
    const late = error.name === "TimeoutError";
    if (late) refused(form, button, "no answer, sending it again", "may not have been accepted");
    else refused(form, button, "no connection to the dashboard");
    // As it would have been without any of this; where nobody listens, when it is pressed again.
    form.dataset.plain = "";
    if (late) form.requestSubmit(button);
  }
  if (answers) setHeld(form, false);
}

export function asking() {
  document.addEventListener("submit", (event) => {
    const form = event.target;
    if (!form.matches(".stopping[data-run], [data-ask]")) return;
    if ("plain" in form.dataset) return void delete form.dataset.plain;
    event.preventDefault();
    if (event.submitter?.getAttribute("aria-disabled") !== "true") ask(form, event.submitter);
  });
  for (const form of document.querySelectorAll("[data-ask]")) {
    if (form.querySelector("[name=answer]")) hold(form);
  }
}
