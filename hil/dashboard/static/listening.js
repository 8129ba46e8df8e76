// News for all pages of a browser by one stream: a browser keeps six connections to a host, and what
// is asked, Stop above all, needs one that is free. One page leads: it holds the stream and shares
// what it hears. Pages that nobody sees do neither. Locks would be simpler, but exist on https only.

const KINDS = ["live", "planned", "run", "over", "beat"];
const SIGN_MS = 1000; // how often a leader says that it leads, and the others what they show
const GONE_MS = 3500; // a leader that has given no sign for so long has gone
const OLD_MS = 5000; // the server beats every two seconds
const AGAIN_MS = 2000;

// A stream does not say why it was refused.
async function why() {
  const signal = AbortSignal.timeout(SIGN_MS);
  const answer = await fetch("/events", { method: "HEAD", signal }).catch(() => null);
  return answer?.status === 503 ? "full" : "lost";
}

// wanted(): the run that this page shows, and how many lines of its log it knows; take(kind, data):
// what has come; old(seconds, full): for how long nothing has, 0 while all is well, and whether that
// is because too many listen.
export function listening(wanted, take, old) {
  const me = `${Date.now()}-${Math.random()}`;
  const channel = new BroadcastChannel("hil-news-1");
  const pages = new Map();
  let [on, leads, lost, full] = [false, false, false, false];
  let [signed, heard, opened, again] = [0, 0, 0, 0];
  let [source, ticking, opening] = [null, 0, 0];
  const now = () => performance.now();

  function lead() {
    leads = true;
    sign();
    open();
  }

  function follow() {
    leads = false;
    source?.close();
    source = null;
  }

  const sign = () => channel.postMessage({ sign: me });
  const want = () => channel.postMessage({ want: me, ...wanted() });

  // Asked again from the start whenever a page has come: it is told how things are now.
  function open() {
    source?.close();
    opened = now();
    source = new EventSource(`/events?${runs()}`);
    for (const kind of KINDS) source.addEventListener(kind, (event) => share(kind, JSON.parse(event.data)));
    source.onerror = () => {
      source?.close(); // refused, it would not try again by itself
      source = null;
      again = now() + AGAIN_MS;
      why().then((kind) => on && leads && !source && share(kind));
    };
  }

  function runs() {
    const known = new Map();
    for (const [page, { at }] of pages) if (now() - at > OLD_MS) pages.delete(page);
    for (const { run, after } of [wanted(), ...pages.values()]) {
      if (run) known.set(run, Math.min(after, known.get(run) ?? after));
    }
    const query = new URLSearchParams();
    for (const [run, after] of known) {
      query.append("run", run);
      query.append("after", after);
    }
    return query;
  }

  function share(kind, data) {
    channel.postMessage({ kind, data });
    came(kind, data);
  }

  function came(kind, data) {
    full = kind === "full";
    lost = full || kind === "lost";
    if (!lost) heard = now();
    show();
    if (!lost) take(kind, data);
  }

  function show() {
    const quiet = now() - heard;
    old(lost || quiet > OLD_MS ? Math.max(1, Math.round(quiet / 1000)) : 0, full);
  }

  function tick() {
    show();
    if (!leads) {
      want();
      if (now() - signed > GONE_MS) lead();
      return;
    }
    sign();
    const quiet = now() - Math.max(heard, opened) > OLD_MS;
    if (source ? quiet : now() >= again) open();
  }

  function wish({ want: page, run, after }) {
    const before = pages.get(page);
    pages.set(page, { run, after, at: now() });
    if (!leads || (before && before.run === run)) return;
    sign();
    clearTimeout(opening);
    opening = setTimeout(() => leads && open(), 100); // several pages may come at once
  }

  // Of two that lead, the one that began first keeps the stream.
  function rival(page) {
    signed = now();
    if (leads && page < me) follow();
    else if (leads) sign();
  }

  channel.onmessage = ({ data }) => {
    if (!on) return;
    if (data.sign) rival(data.sign);
    else if (data.want) wish(data);
    else if (data.gone) setTimeout(() => on && now() - signed > 500 && lead(), 500 + 300 * Math.random());
    else if (!leads) came(data.kind, data.data);
  };

  function start() {
    if (on) return;
    [on, lost, heard, signed] = [true, false, now(), 0];
    const begun = now();
    want();
    setTimeout(() => on && !leads && signed < begun && lead(), 150);
    ticking = setInterval(tick, SIGN_MS);
  }

  function stop() {
    if (!on) return;
    on = false;
    clearInterval(ticking);
    if (leads) channel.postMessage({ gone: me });
    follow();
  }

  document.addEventListener("visibilitychange", () => (document.hidden ? stop() : start()));
  addEventListener("pagehide", stop);
  if (!document.hidden) start();
}
