// The page: which drives there are, which one is shown, and whether the daemon is there at all.

import { drivePath, get, post } from "./api.js";
import { renderConnection } from "./facts.js";
import { DriveView } from "./view.js";

const POLL_MS = 1000;
const byId = (id) => document.getElementById(id);
let view = null;
let live = false;
let answers = false;

function show(name) {
  view?.close();
  live = false;
  byId("events").replaceChildren();
  view = new DriveView(name, Number(byId("window").value), (open) => {
    live = open;
    refresh();
  });
  if (byId("drive").value !== name) byId("drive").value = name;
  document.title = `${name} · servo-daemon`;
  history.replaceState(null, "", `#${encodeURIComponent(name)}`);
}

/** The picker follows the list without losing the choice; each entry tells how its drive is. */
function fillPicker(drives) {
  const picker = byId("drive");
  if (picker.length !== drives.length) {
    picker.replaceChildren(...drives.map((drive) => new Option(drive.name, drive.name)));
  }
  drives.forEach((drive, k) => {
    const text = drive.connection === "connected" ? drive.name : `${drive.name} (${drive.connection})`;
    if (picker.options[k].text !== text) picker.options[k].text = text;
  });
}

function chosen(drives) {
  const wanted = decodeURIComponent(location.hash.slice(1));
  return (drives.find((drive) => drive.name === wanted) ?? drives[0]).name;
}

async function refresh() {
  try {
    const { drives } = await get("/drives");
    fillPicker(drives);
    if (view === null) show(chosen(drives));
    const drive = await view.poll();
    answers = true;
    byId("driver").textContent = drive.driver;
    const following = live || drive.connection !== "connected";
    renderConnection(following ? drive.connection : "loading", drive.name, drive.reason);
  } catch (error) {
    if (answers || view === null) console.info(`the daemon does not answer: ${error.message}`);
    answers = false;
    renderConnection("lost", view?.name ?? "", null);
  }
}

async function poll() {
  await refresh();
  setTimeout(poll, POLL_MS);
}

byId("drive").addEventListener("change", (event) => show(event.target.value));
byId("window").addEventListener("change", () => view && show(view.name));
window.addEventListener("hashchange", () => {
  const name = decodeURIComponent(location.hash.slice(1));
  if ([...byId("drive").options].some((option) => option.value === name)) show(name);
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
  .then(({ version }) => (byId("version").textContent = `servo-daemon ${version}`))
  .catch(() => {});
poll();
