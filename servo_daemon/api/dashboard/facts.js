// The line of facts at the top, the banner, and the list of events.

import { captureLink, captureOf } from "./captures.js";
import { NOTHING, count, fixed } from "./format.js";

const byId = (id) => document.getElementById(id);
const EVENTS_SHOWN = 200;
const STATES = {
  connected: "connected", connecting: "waiting for samples", silent: "silent", down: "drive down", ended: "ended",
  lost: "reconnecting…", loading: "loading…",
};

function write(id, text) {
  if (byId(id).textContent !== text) byId(id).textContent = text;
}

/** How the drive and the way to it are: a connection state, "loading" until the stream runs, "lost" without an answer. */
export function renderConnection(state, drive, reason) {
  const pill = byId("connection");
  if (pill.dataset.state !== state) pill.dataset.state = state;
  write("connection", STATES[state] ?? state);
  const why = reason ? `: ${reason}` : "";
  const text = {
    lost: "The daemon does not answer. Trying again; the numbers below are the last that arrived.",
    down: `Drive ${drive} is away${why}. The daemon keeps trying; the numbers below are the last known.`,
    silent: `Drive ${drive} is open but sends nothing${why}. The numbers below are the last known.`,
    connecting: `Drive ${drive} has not sent samples yet${why}.`,
    ended: `The source of ${drive} is finished${why}.`,
  }[state];
  const banner = byId("banner");
  if (text) write("banner", text);
  banner.hidden = !text;
  banner.dataset.state = state;
  document.body.dataset.connection = state;
}

/** How many of all drives are connected. */
export function renderFleetConnection(drives) {
  const connected = drives.filter((drive) => drive.connection === "connected").length;
  renderConnection(connected === drives.length ? "connected" : "connecting", "", null);
  write("connection", `${connected} of ${drives.length} connected`);
  byId("banner").hidden = true;
}

export function renderFacts(estimates) {
  const { health } = estimates;
  const rate = estimates.sample_rate_hz;
  write("rate", rate === null ? NOTHING : `${fixed(rate, rate < 100 ? 1 : 0)} Hz`);
  write("samples", count(health.samples ?? estimates.samples));
  const lost = health.samples_lost ?? 0;
  write("lost", health.overloaded ? `${count(lost)}, overloaded` : count(lost));
  byId("lost").classList.toggle("bad", lost > 0);
  const white = health.innovation_white;
  write("white", white === true ? "white" : white === false ? "not white" : NOTHING);
  byId("white").classList.toggle("bad", white === false);
  renderLearned(estimates.estimators.grnn);
  write("model", ["linear motor", ...estimates.model.map((name) => name.replaceAll("_", " "))].join(" + "));
}

/** What the model that refreshes the estimates is doing. */
function renderLearned(grnn) {
  byId("learned-fact").hidden = grnn === undefined;
  if (grnn === undefined) return;
  const { mode, reason, declined, motors_done: done, motors } = grnn.detail;
  const text = mode === "training" ? `training, ${count(done)} of ${count(motors)}` : declined ? "declined" : mode;
  write("learned", text);
  byId("learned-fact").title = declined ?? reason ?? "";
}

/** Why the history is shorter than it could be; null: it is not. */
export function renderNote(note) {
  write("history-note", note ?? "");
  byId("history-note").hidden = !note;
}

/** A number with the four digits that a message has, too. */
const short = (value) => (typeof value === "number" ? Number(value.toPrecision(4)) : value);

/** Whether a message has the value, with two digits or more. */
const says = (message, value) => (typeof value === "number" ? [2, 3, 4].some((n) => message.includes(Number(value.toPrecision(n)))) : message.includes(value));

/** A key and its value in words: `waited_s` 5.3 is "waited 5.3 s". */
function fact(key, value) {
  const [, name, unit] = /^(.+)_(s|h|min|A|V|Hz|days|years)$/.exec(key) ?? [key, key, ""];
  return `${name.replaceAll("_", " ")} ${value} ${unit}`.trim();
}

function eventItem(event, capture) {
  const item = document.createElement("li");
  item.id = eventId(event);
  item.tabIndex = -1;
  const time = document.createElement("time");
  time.dateTime = event.time;
  // Sweden writes dates as 2026-11-21 12:45:21, which everybody reads the same way.
  time.textContent = new Date(event.time).toLocaleString("sv-SE");
  const kind = document.createElement("b");
  kind.textContent = event.kind.replaceAll("_", " ");
  const more = Object.entries(event.data).filter(([key, value]) => !TOLD.has(key) && !says(event.message, value));
  const data = more.map(([key, value]) => fact(key, short(value))).join(", ");
  const message = document.createElement("span");
  message.textContent = event.message + (data ? ` (${data})` : "");
  item.append(time, kind, message);
  if (capture) item.append(captureLink(capture, "samples"));
  return item;
}

/** What the message says in its own words, or nobody needs. */
const TOLD = new Set(["alarm", "parameter", "unit", "age_s", "time_s"]);

const eventId = (event) => `event-${event.kind}-${Date.parse(event.time)}`;

/** Newest first; each with the recording that it is in. */
export function renderEvents(events, captures) {
  const newest = events.slice(-EVENTS_SHOWN).reverse();
  byId("events").replaceChildren(...newest.map((event) => eventItem(event, captureOf(event, captures))));
  byId("no-events").hidden = newest.length > 0;
}

/** Shows an event in the list. */
export function openEvent(event) {
  if (document.fullscreenElement) document.exitFullscreen();
  const item = byId(eventId(event));
  item?.scrollIntoView({ block: "center" });
  item?.focus();
}
