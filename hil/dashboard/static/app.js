// What makes pages live; every page can be read, and every run be stopped, without it.
// Elements are changed in place and never replaced, so that nobody loses the place they are at.

import { asking, hold, setText } from "./asking.js";
import { listening } from "./listening.js";

const KEPT = 240; // numbers of a small curve: a minute at four a second
const LINES = 200;
const byId = (id) => document.getElementById(id);

function setShown(element, shown) {
  if (element.hidden === !shown) return;
  if (!shown && element.contains(document.activeElement)) (byId("standing") || byId("main")).focus();
  element.hidden = !shown;
}

// --- live runs in the header and on the overview --------------------------------------------

// The entries of the header of one kind, `data-run` or `data-planned`: made, shown, taken away.
function showEntries(kind, template, news, make, show) {
  const box = byId("live");
  const known = new Map([...box.querySelectorAll(`[data-${kind}]`)].map((form) => [form.dataset[kind], form]));
  for (const [id, one] of news) {
    let form = known.get(id);
    known.delete(id);
    if (!form) {
      form = byId(template).content.firstElementChild.cloneNode(true);
      form.dataset[kind] = id;
      make(form, one);
      box.append(form);
    }
    show(form, one);
  }
  for (const form of known.values()) {
    if (form.contains(document.activeElement)) byId("main").focus();
    form.remove();
  }
}

function named(form, name, address, what) {
  form.action = `${address}/${what}`;
  const link = form.querySelector("a");
  link.href = address;
  link.textContent = name;
  const sr = form.querySelector(".sr");
  if (sr) sr.textContent = ` ${name}`;
}

function showHeader(runs) {
  const make = (form, run) => named(form, run.name, run.address, "stop");
  showEntries("run", "stopping", runs.map((run) => [run.name, run]), make, showRun);
}

function showPlanned(all) {
  const make = (form, one) => named(form, one.spec, one.address, "cancel");
  const show = (form, one) => setText(form.querySelector(".how"), one.text);
  showEntries("planned", "planning", all.map((one) => [one.id, one]), make, show);
}

function showRun(element, run) {
  const how = element.querySelector(".how");
  setText(how, run.over ? run.text : `${run.done} · ${run.text}`);
  how.classList.toggle("asks", run.asks);
  how.classList.toggle("silent", run.silent);
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
    const text = card.querySelector(".text");
    setText(text, run.text);
    text.classList.toggle("silent", run.silent);
    setText(card.querySelector(".left"), `${run.done}, ${run.left}`);
    card.querySelector("progress").value = run.percent;
  });
}

// This page made again by the server: its document, and its address, which may be another by now.
async function again() {
  const answer = await fetch(location.href, { headers: { Accept: "text/html" } }).catch(() => null);
  const text = answer?.ok && (await answer.text().catch(() => ""));
  return text ? { fresh: new DOMParser().parseFromString(text, "text/html"), moved: answer.redirected && answer.url } : {};
}

// Parts of the page made again; what holds the focus is left for later.
async function refresh(...ids) {
  const { fresh } = await again();
  if (!fresh) return;
  for (const id of ids) {
    const [here, there] = [byId(id), fresh.getElementById(id)];
    if (!there || here.contains(document.activeElement)) continue;
    for (const part of there.querySelectorAll("details[id]")) part.open ||= Boolean(byId(part.id)?.open);
    here.replaceChildren(...there.childNodes);
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

// What was said at a button is of before; aria-disabled keeps the focus where it is.
function setCan(button, can) {
  if ((button.getAttribute("aria-disabled") !== "true") === can) return;
  button.setAttribute("aria-disabled", String(!can));
  setText(button.form.querySelector(".said"), "");
}

function showNow(run, now) {
  for (const input of run.querySelectorAll("form [data-input], form [data-value]")) {
    const value = String(now.texts[input.dataset.input] ?? now.values[input.dataset.value]);
    if (input.value === value) continue;
    hold(input.form); // another question: nobody has read it yet
    input.value = value;
  }
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
  for (const element of run.querySelectorAll("[data-shown]")) setShown(element, now.shown[element.dataset.shown]);
  for (const [key, value] of Object.entries(now.series)) addTo(key, value);
  for (const svg of run.querySelectorAll("[data-spark]")) draw(svg);
  for (const button of run.querySelectorAll("[data-can]")) setCan(button, now.can[button.dataset.can]);
  addLines(now.log);
  if (now.over) for (const button of run.querySelectorAll("button")) button.setAttribute("aria-disabled", "true");
}

// --- what was started and is no run yet ------------------------------------------------------

const LOOK_MS = 1000;
let nextLook = 0;

// In place, so that the keyboard stays at Cancel, until there is a run or the process has ended.
async function lookAtStart() {
  clearTimeout(nextLook);
  const { fresh, moved } = await again();
  if (moved) return void location.replace(moved);
  if (fresh && !fresh.querySelector("[data-starting]")) return void location.reload();
  for (const id of fresh ? ["how", "printed"] : []) setText(byId(id), fresh.getElementById(id).textContent);
  byId("printed").hidden = !byId("printed").textContent;
  clearTimeout(nextLook);
  nextLook = setTimeout(lookAtStart, LOOK_MS);
}

const starting = document.querySelector("[data-starting]");
if (starting) nextLook = setTimeout(lookAtStart, LOOK_MS);

// --- listening ------------------------------------------------------------------------------

const run = byId("run");

function wanted() {
  if (!run || "over" in run.dataset) return { run: "", after: 0 };
  return { run: run.dataset.name, after: Number(byId("log").querySelector("li")?.dataset.line || 0) };
}

function take(kind, news) {
  if (starting && kind === "planned") lookAtStart();
  if (kind === "live") {
    showHeader(news);
    showOverview(news);
  } else if (kind === "planned") {
    showPlanned(news);
  } else if (run && news.name === run.dataset.name && !("over" in run.dataset)) {
    if (kind === "over") run.dataset.over = "";
    showNow(run, news);
  }
}

// The seconds are not read aloud, or they would be said every second.
function showOld(seconds, full) {
  const box = byId("old");
  document.body.classList.toggle("old", seconds > 0);
  if (!seconds) return void box.replaceChildren();
  if (!box.firstChild || box.dataset.full !== String(full)) {
    const count = document.createElement("span");
    count.ariaHidden = "true";
    box.dataset.full = full;
    if (full) box.replaceChildren("Too many open browsers", count, ": close some, or reload this page. The data shown are old; Stop works.");
    else box.replaceChildren("No data from the dashboard", count, ": the data shown are old. Only the robot’s own button is sure to stop it.");
  }
  box.querySelector("span").textContent = full ? "" : ` for ${seconds} s`;
}

// A page that comes back from the browser's memory has no connection any more.
addEventListener("pageshow", (event) => event.persisted && location.reload());

asking();
listening(wanted, take, showOld);
