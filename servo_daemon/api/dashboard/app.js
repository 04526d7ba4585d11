// The page: which drives there are, whether one or all are shown, and whether the daemon is there at all.

import { drivePath, get, post } from "./api.js";
import { renderConnection, renderFleetConnection } from "./facts.js";
import { pollFleet } from "./fleet.js";
import { DriveView, POLL_MS } from "./view.js";

const LIST_EVERY = 5; // polls of one drive: the picker tells of the others
const byId = (id) => document.getElementById(id);
let view = null;
let live = false;
let answers = false;
let polls = 0; // since the list of drives was asked for
let timer;

const wanted = () => decodeURIComponent(location.hash.slice(1));
const ALL = "";

/** One drive, or ALL. */
function show(name) {
  view?.close();
  view = null;
  live = false;
  byId("events").replaceChildren();
  const change = document.body.dataset.view === undefined ? "replaceState" : "pushState";
  if (wanted() !== name) history[change](null, "", `#${encodeURIComponent(name)}`);
  document.body.dataset.view = name === ALL ? "fleet" : "drive";
  byId("fleet").hidden = name !== ALL;
  byId("drive").value = name;
  document.title = name === ALL ? "servo-daemon" : `${name} · servo-daemon`;
  if (name === ALL) return;
  view = new DriveView(name, Number(byId("window").value), (open) => {
    live = open;
    refresh();
  });
}

/** The picker follows the list without losing the choice, unless that drive has gone; each entry tells how its drive is. */
function fillPicker(drives) {
  const picker = byId("drive");
  const names = [...(drives.length > 1 ? [ALL] : []), ...drives.map(({ name }) => name)];
  const before = Array.from(picker.options, ({ value }) => value);
  if (JSON.stringify(names) !== JSON.stringify(before)) {
    const choice = picker.value;
    picker.replaceChildren(...names.map((name) => new Option(name === ALL ? "all drives" : name, name)));
    if (names.includes(choice)) picker.value = choice;
    else if (document.body.dataset.view !== undefined) show(chosen(drives));
  }
  drives.forEach((drive, k) => label(picker.options[k + names.length - drives.length], drive));
}

function label(option, { name, connection }) {
  const text = connection === "connected" ? name : `${name} (${connection})`;
  if (option.text !== text) option.text = text;
}

/** The drive that the address names, else all, else the only one. */
function chosen(drives) {
  const named = drives.find((drive) => drive.name === wanted());
  return named?.name ?? (drives.length > 1 ? ALL : drives[0].name);
}

async function listDrives() {
  const { drives } = await get("/drives");
  polls = 0;
  fillPicker(drives);
  if (document.body.dataset.view === undefined) show(chosen(drives));
}

async function refresh() {
  try {
    if (document.body.dataset.view === undefined || (view !== null && ++polls >= LIST_EVERY)) await listDrives();
    if (view === null) {
      const drives = await pollFleet();
      answers = true;
      fillPicker(drives);
      renderFleetConnection(drives);
      return;
    }
    const shown = view;
    const drive = await shown.poll();
    answers = true;
    if (shown !== view) return;
    for (const option of byId("drive").options) if (option.value === drive.name) label(option, drive);
    byId("driver").textContent = drive.driver;
    const following = live || drive.connection !== "connected";
    renderConnection(following ? drive.connection : "loading", drive.name, drive.reason);
  } catch (error) {
    if (answers || document.body.dataset.view === undefined) console.info(`the daemon does not answer: ${error.message}`);
    answers = false;
    renderConnection("lost", view?.name ?? "", null);
  }
}

/** Nobody looks at a hidden page: it asks nothing once it has found its drive. */
async function poll() {
  if (!document.hidden || document.body.dataset.view === undefined) await refresh();
  clearTimeout(timer);
  timer = setTimeout(poll, POLL_MS);
}

document.addEventListener("visibilitychange", () => document.hidden || poll());
byId("drive").addEventListener("change", (event) => {
  show(event.target.value);
  refresh();
});
byId("window").addEventListener("change", () => view && show(view.name));
/** Also by the buttons back and forward. */
window.addEventListener("hashchange", () => {
  const name = wanted();
  if (view?.name !== name && [...byId("drive").options].some((option) => option.value === name)) {
    show(name);
    refresh();
  }
});
byId("reset").addEventListener("click", async () => {
  const question = `Forget what was learned of ${view.name} and start from its nominal values?`;
  if (!window.confirm(question)) return;
  try {
    await post(`${drivePath(view.name)}/reset`);
  } catch (error) {
    window.alert(`The reset was refused: ${error.message}`);
  }
});

get("/health")
  .catch(({ document }) => document) // 503: health with its problems
  .then((health) => health?.version && (byId("version").textContent = `servo-daemon ${health.version}`));
poll();
