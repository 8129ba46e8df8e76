// What makes pages live; every page can be read, and every run be stopped, without it.
// Elements are changed in place and never replaced, so that nobody loses the place they are at.

const KEPT = 240; // numbers of a small curve: a minute at four a second
const LINES = 200;
const byId = (id) => document.getElementById(id);

// Setting a text that is there already would have screen readers say it again.
function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function setShown(element, shown) {
  if (element.hidden === !shown) return;
  if (!shown && element.contains(document.activeElement)) (byId("standing") || byId("main")).focus();
  element.hidden = !shown;
}

// --- asking ---------------------------------------------------------------------------------

async function ask(form, button) {
  const said = byId("asked") || byId("link");
  const body = new URLSearchParams(new FormData(form, button));
  try {
    const answer = await fetch(form.action, { method: "POST", body, headers: { Accept: "application/json" } });
    const told = await answer.json().catch(() => ({ error: `${answer.status} ${answer.statusText}` }));
    setText(said, answer.ok ? `asked: ${told.asked}` : [told.error, told.hint].filter(Boolean).join(" → "));
  } catch {
    form.submit(); // as it would have been without any of this
  }
}

document.addEventListener("submit", (event) => {
  const form = event.target;
  if (!form.matches(".stopping, [data-ask]")) return;
  event.preventDefault();
  if (event.submitter?.getAttribute("aria-disabled") === "true") return;
  ask(form, event.submitter);
});

// --- live runs in the header and on the overview --------------------------------------------

function showHeader(runs) {
  const box = byId("live");
  const known = new Map([...box.querySelectorAll("[data-run]")].map((form) => [form.dataset.run, form]));
  for (const run of runs) {
    let form = known.get(run.name);
    known.delete(run.name);
    if (!form) {
      form = byId("stopping").content.firstElementChild.cloneNode(true);
      form.dataset.run = run.name;
      form.action = `${run.address}/stop`;
      const link = form.querySelector("a");
      link.href = run.address;
      link.textContent = run.name;
      const sr = form.querySelector(".sr");
      if (sr) sr.textContent = ` ${run.name}`;
      box.append(form);
    }
    showRun(form, run);
  }
  for (const form of known.values()) {
    if (form.contains(document.activeElement)) byId("main").focus();
    form.remove();
  }
}

function showRun(element, run) {
  const how = element.querySelector(".how");
  setText(how, run.over ? run.text : `${run.percent} % · ${run.text}`);
  how.classList.toggle("asks", run.asks);
  element.querySelector(".stop")?.setAttribute("aria-disabled", String(run.over));
}

function showOverview(runs) {
  const box = byId("going");
  if (!box) return;
  const shown = [...box.querySelectorAll("[data-card]")];
  const same = shown.map((card) => card.dataset.card).join() === runs.map((run) => run.name).join();
  if (!same) return void refresh("going", "newest", "stations");
  shown.forEach((card, i) => {
    const run = runs[i];
    setText(card.querySelector(".text"), run.text);
    setText(card.querySelector(".left"), `${run.percent} %, ${run.left}`);
    card.querySelector("progress").value = run.percent;
  });
}

// Parts of the page made again by the server; what holds the focus is left for later.
async function refresh(...ids) {
  const answer = await fetch(location.href, { headers: { Accept: "text/html" } }).catch(() => null);
  if (!answer?.ok) return;
  const fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
  for (const id of ids) {
    const [here, there] = [byId(id), fresh.getElementById(id)];
    if (there && !here.contains(document.activeElement)) here.replaceChildren(...there.childNodes);
  }
}

// --- one live run ---------------------------------------------------------------------------

const curves = new Map();

function addTo(key, value) {
  const numbers = curves.get(key) || [];
  numbers.push(value);
  if (numbers.length > KEPT) numbers.shift();
  curves.set(key, numbers);
}

// At least so much room, or noise would look like a storm; with `zero` as much below as above it.
function range(numbers, { room, zero }) {
  let [low, high] = [Math.min(...numbers), Math.max(...numbers)];
  if (zero !== undefined) [low, high] = [-1, 1].map((side) => side * Math.max(-low, high));
  const more = Math.max(0, Number(room) - (high - low)) / 2;
  return [low - more, high + more];
}

function draw(svg) {
  const numbers = curves.get(svg.dataset.spark);
  if (!numbers || numbers.length < 2) return;
  const [low, high] = range(numbers, svg.dataset);
  const room = high - low;
  const point = (value, i) => `${((120 * i) / (KEPT - 1)).toFixed(1)},${(23 - (22 * (value - low)) / room).toFixed(1)}`;
  svg.querySelector("polyline").setAttribute("points", numbers.map(point).join(" "));
}

function addLines(lines) {
  const log = byId("log");
  let last = Number(log.querySelector("li")?.dataset.line || 0);
  for (const line of lines.filter((one) => one.n > last)) {
    const item = document.createElement("li");
    const clock = document.createElement("time");
    item.dataset.line = line.n;
    clock.textContent = line.clock;
    item.append(clock, ` ${line.text}`);
    log.prepend(item);
    last = line.n;
  }
  while (log.children.length > LINES) log.lastElementChild.remove();
}

function showNow(run, now) {
  const shape = [now.joints.length, now.margins.join(" ")].join();
  if (now.shown.arm && shape !== [run.dataset.joints, run.dataset.margins].join()) {
    run.dataset.joints = now.joints.length;
    run.dataset.margins = now.margins.join(" ");
    refresh("arm");
  }
  for (const element of run.querySelectorAll("[data-text]")) {
    const text = now.texts[element.dataset.text];
    if (text !== undefined) setText(element, text);
  }
  for (const element of run.querySelectorAll("[data-value]")) {
    const value = now.values[element.dataset.value];
    if (value !== undefined) element.value = value;
  }
  for (const element of run.querySelectorAll("[data-input]")) element.value = now.texts[element.dataset.input];
  for (const element of run.querySelectorAll("[data-shown]")) setShown(element, now.shown[element.dataset.shown]);
  for (const [key, value] of Object.entries(now.series)) addTo(key, value);
  for (const svg of run.querySelectorAll("[data-spark]")) draw(svg);
  addLines(now.log);
  if (now.over) for (const button of run.querySelectorAll("button")) button.setAttribute("aria-disabled", "true");
}

// --- listening ------------------------------------------------------------------------------

// One connection a page, and none while nobody sees it: a browser keeps six to a host, and what is
// asked, Stop above all, needs one that is free.
const run = byId("run");
let source = null;

function showLive(runs) {
  showHeader(runs);
  showOverview(runs);
}

function address() {
  if (!run || "over" in run.dataset) return "/events";
  return `${run.dataset.events}?after=${byId("log").querySelector("li")?.dataset.line || 0}`;
}

function listen() {
  source?.close();
  source = new EventSource(address());
  source.onopen = () => setText(byId("link"), "");
  source.onerror = () => setText(byId("link"), "No connection to the dashboard: what is shown is old. ");
  const told = (kind, take) => source.addEventListener(kind, (event) => take(JSON.parse(event.data)));
  told("live", showLive);
  told("run", (now) => showNow(run, now));
  told("over", (now) => {
    showNow(run, now);
    run.dataset.over = "";
    listen();
  });
}

document.addEventListener("visibilitychange", () => (document.hidden ? source?.close() : listen()));
addEventListener("pagehide", () => source?.close());

// A page that comes back from the browser's memory has no connection any more.
addEventListener("pageshow", (event) => event.persisted && location.reload());

if (!document.hidden) listen();
