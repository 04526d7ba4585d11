// The page: which drives there are, whether one or all are shown, and whether the daemon is there at all.

import { drivePath, get, post } from "./api.js";
import { renderConnection, renderFleetConnection } from "./facts.js";
import { pollFleet } from "./fleet.js";
import { DriveView } from "./view.js";

const POLL_MS = 1000;
const byId = (id) => document.getElementById(id);
let view = null;
let live = false;
let answers = false;

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

/** The picker follows the list without losing the choice; each entry tells how its drive is. */
function fillPicker(drives) {
  const picker = byId("drive");
  const all = drives.length > 1 ? [new Option("all drives", ALL)] : [];
  if (picker.length !== drives.length + all.length) {
    picker.replaceChildren(...all, ...drives.map((drive) => new Option(drive.name, drive.name)));
  }
  drives.forEach((drive, k) => {
    const text = drive.connection === "connected" ? drive.name : `${drive.name} (${drive.connection})`;
    const option = picker.options[k + all.length];
    if (option.text !== text) option.text = text;
  });
}

/** The drive that the address names, else all, else the only one. */
function chosen(drives) {
  const named = drives.find((drive) => drive.name === wanted());
  return named?.name ?? (drives.length > 1 ? ALL : drives[0].name);
}

async function refresh() {
  try {
    const { drives } = await get("/drives");
    fillPicker(drives);
    if (document.body.dataset.view === undefined) show(chosen(drives));
    if (view === null) {
      await pollFleet();
      answers = true;
      renderFleetConnection(drives);
      return;
    }
    const shown = view;
    const drive = await shown.poll();
    answers = true;
    if (shown !== view) return;
    byId("driver").textContent = drive.driver;
    const following = live || drive.connection !== "connected";
    renderConnection(following ? drive.connection : "loading", drive.name, drive.reason);
  } catch (error) {
    if (answers || document.body.dataset.view === undefined) console.info(`the daemon does not answer: ${error.message}`);
    answers = false;
    renderConnection("lost", view?.name ?? "", null);
  }
}

async function poll() {
  await refresh();
  setTimeout(poll, POLL_MS);
}

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
