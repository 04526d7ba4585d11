// Alarms that ring: their words in a banner, and which parameter and limit they are about.

const byId = (id) => document.getElementById(id);

/** Names of the alarms that ring: keys of [drive.limits], controller_margin. */
export const ringing = (estimates) => String(estimates?.health.alarms ?? "").split(",").filter(Boolean);

/** An event of the alarm's beginning: those of a parameter say which, the one of the margins is the only one of its kind. */
const begins = (name) => (event) =>
  name === "controller_margin" ? event.kind === "margin_low" : event.kind === "alarm" && event.data.alarm === name;

/** What an alarm says: in the daemon's words where its event is still known. */
function words(name, events, limits) {
  const event = events.findLast(begins(name));
  if (event) return `${event.message} (since ${new Date(event.time).toLocaleString("sv-SE")})`;
  const limit = limits.find((l) => l.name === name);
  if (!limit) return `${name.replaceAll("_", " ")} is too low`;
  return `${limit.parameter} is ${limit.is_upper ? "above" : "below"} its limit ${name}`;
}

/** Written only when it changes: a screen reader says it each time. */
export function renderAlarms(names, events, limits) {
  const text = names.map((name) => `Alarm: ${words(name, events, limits)}.`).join(" ");
  if (byId("alarms").textContent !== text) byId("alarms").textContent = text;
  byId("alarms").hidden = text === "";
}
