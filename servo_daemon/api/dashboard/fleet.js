// All drives at a glance: one row each, a click opens the drive.

import { get } from "./api.js";
import { typeset } from "./format.js";
import { sparkline } from "./sparkline.js";

const byId = (id) => document.getElementById(id);
const spaced = (name) => name.replaceAll("_", " ");
const MOST_PROBLEMS = 4;
const KNOWN = ["tracking", "unexcited", "fixed"];

/** What is to be done about a drive, the most urgent; null: nothing. */
export function toDo(drive) {
  const { worst, diagnosis, alarms, statuses } = drive;
  const refused = drive.connection === "connecting" && drive.reason;
  if (refused || drive.connection === "down" || drive.connection === "silent") return `Check supply and line: ${drive.reason ?? drive.connection}`;
  if (alarms.includes("controller_margin")) return "Tune again: the controller's margins are too small";
  if (alarms.length) return `Inspect what ${worst?.parameter ?? alarms[0]} depends on`;
  if (statuses.invalid || statuses.at_bound) return `See why ${worst.parameter} cannot be told`;
  const lacks = diagnosis.effects.filter((name) => !drive.model.includes(name));
  if (diagnosis.verdict === "found" && lacks.length) return `Decide about ${lacks.map(spaced).join(" + ")}: found by the diagnosis`;
  if (statuses.estimating && drive.connection === "connected") return "Let it move: not all parameters are known yet";
  return null;
}

function known(drive) {
  const all = Object.values(drive.statuses).reduce((sum, n) => sum + n, 0);
  return `${KNOWN.reduce((sum, status) => sum + (drive.statuses[status] ?? 0), 0)} of ${all} known`;
}

function cell(row, label, className, text) {
  const made = row.insertCell();
  made.dataset.label = label;
  const inner = document.createElement("span");
  inner.className = className;
  inner.textContent = text;
  made.append(inner);
  return inner;
}

function badge(text) {
  return Object.assign(document.createElement("span"), { className: "badge ringing", textContent: text });
}

function fill(row, drive) {
  const name = document.createElement("th");
  name.scope = "row";
  const link = document.createElement("a");
  link.href = `#${encodeURIComponent(drive.name)}`;
  link.textContent = drive.name;
  name.append(link);
  if (drive.simulated) name.append(Object.assign(document.createElement("small"), { textContent: " simulated" }));
  row.append(name);
  cell(row, "Status", "pill", drive.connection).dataset.state = drive.connection;
  cell(row, "Parameters", "", known(drive));
  const { worst, reason } = drive; // of a drive that is away all parameters say what is to be done says, too
  cell(row, "Look at", "", worst && worst.why !== reason ? `${worst.parameter}: ${typeset(worst.why)}` : "–");
  cell(row, "Last 30 days", "sparks", "").dataset.parameter = drive.worst?.parameter ?? Object.keys(drive.parameters)[0] ?? "";
  const alarms = drive.alarms.map((name) => (name === "controller_margin" ? spaced(name) : name));
  const first = cell(row, "Alarms", alarms.length ? "badge ringing" : "quiet", alarms[0] ?? "none");
  first.after(...alarms.slice(1).flatMap((name) => [" ", badge(name)]));
  const todo = toDo(drive);
  cell(row, "To do", todo ? "todo" : "quiet", todo ? typeset(todo) : "nothing");
}

function curve(row, drive) {
  const element = row.querySelector(".sparks");
  if (element.dataset.parameter) sparkline(element, drive.name, element.dataset.parameter);
}

/** Rows are written anew only when they change, so that focus and selection stay. */
function render(drives) {
  const rows = byId("fleet-rows");
  while (rows.rows.length > drives.length) rows.deleteRow(-1);
  drives.forEach((drive, k) => {
    const { time: _time, parameters: _parameters, ...shown } = drive;
    const key = JSON.stringify(shown);
    const row = rows.rows[k] ?? rows.insertRow();
    if (row.dataset.key === key) {
      curve(row, drive);
      return;
    }
    const focused = row.contains(document.activeElement);
    row.dataset.key = key;
    row.replaceChildren();
    fill(row, drive);
    row.classList.toggle("alarm", drive.alarms.length > 0);
    row.onclick = () => (location.hash = encodeURIComponent(drive.name));
    if (focused) row.querySelector("a").focus();
    curve(row, drive);
  });
}

/** What is wrong with the daemon, a line each; a whole fleet's worth would push the table off the screen. */
function tell(problems) {
  const banner = byId("fleet-problems");
  const more = problems.length - MOST_PROBLEMS;
  const lines = more > 0 ? [...problems.slice(0, MOST_PROBLEMS), `and ${more} more: /api/v1/health`] : problems;
  const text = lines.join("\n");
  if (banner.textContent !== text) banner.textContent = text; // written again it would be read out again
  banner.hidden = problems.length === 0;
}

/** The drives, as they are drawn now. */
export async function pollFleet() {
  const { drives, problems } = await get("/fleet");
  render(drives);
  tell(problems);
  return drives;
}
