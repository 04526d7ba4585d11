// What the model lacks: the last diagnosis of the drive, its verdict, and the buttons to begin one and to adopt it.

import { drivePath, get, post } from "./api.js";
import { charts } from "./chart.js";
import { pair, percent, scaleFor } from "./format.js";
import { drawUnmodelled, unmodelledText } from "./unmodelled.js";

const byId = (id) => document.getElementById(id);
const ADOPT_TIMEOUT_MS = 40_000; // a model that this machine has not seen yet is compiled first
const ASK_EVERY = 5;
const BADGES = {
  idle: "not looked at yet", running: "◔ looking…", failed: "✕ failed", none: "● nothing is missing",
  found: "▲ found", adopted: "● adopted", unexplained: "◌ no name for it",
};
const words = (name) => name.replaceAll("_", " ");
const named = (effects) => ["linear motor", ...effects.map(words)].join(" + ");

function write(id, text) {
  if (byId(id).textContent !== text) byId(id).textContent = text;
  byId(id).hidden = text === "";
}

function element(tag, className, text) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  made.textContent = text;
  return made;
}

/** 12.50 ± 0.40 mN·m */
function value(name, parameter) {
  if (typeof parameter.value !== "number") return `${name} = ${parameter.value ?? "–"}`;
  const scale = scaleFor(parameter.unit ?? "", parameter.value);
  const shown = pair(parameter.value, parameter.std, scale);
  return `${name} = ${[shown.value, shown.std, scale.unit].filter(Boolean).join(" ")}`;
}

/** 93.0 %; a minus where more is left than before */
const share = (ratio) => (ratio < 0 ? percent(ratio) : percent(ratio).slice(1));

/** What goes with the effects, of which data, and how sure that is. */
function gained(gain) {
  if (typeof gain?.error_removed !== "number") return "";
  const [low, high] = gain.ci95 ?? [null, null];
  const ends = [low === null ? "" : `from ${share(low)}`, high === null ? "" : `to ${share(high)}`].filter(Boolean);
  const interval = ends.length ? ` (95 %: ${ends.join(" ")})` : "";
  const where = gain.measured_on === "choosing" ? " on the validation data, as there is too little to hold a part out" : "";
  return `; with it ${share(gain.error_removed)} of the error is gone${interval}${where}`;
}

function foundItem(effect) {
  const item = document.createElement("li");
  const head = element("p", "found-name", "");
  head.append(element("b", "", words(effect.name)));
  if (typeof effect.gain === "number") head.append(element("span", "", ` removes ${share(effect.gain)} of the error`));
  const numbers = Object.entries(effect.parameters).map(([name, parameter]) => value(name, parameter)).join(", ");
  item.append(head, element("p", "found-cause", effect.cause ?? ""), element("p", "found-values", numbers));
  const others = (effect.equivalent ?? []).map((names) => names.map(words).join(" + "));
  if (others.length) item.append(element("p", "quiet", `These data fit ${others.join(" or ")} as well.`));
  return item;
}

/** What a residual without a name follows; each entry a word or a record. */
function follows(result) {
  const on = (result.remaining?.depends_on ?? []).map((entry) => (typeof entry === "string" ? entry : entry.on));
  return on.filter(Boolean).join(", ");
}

/** Whether the drive's model has by now what was found. */
function isAdopted(d, model) {
  const effects = d.status === "done" && d.result.verdict === "found" ? d.adoption.effects : null;
  return effects !== null && effects.length === model.length && effects.every((name) => model.includes(name));
}

/** What there was no time for, and that it need not be lost. */
function unfinished(d) {
  const rest = d.status === "done" ? d.result.unfinished : null;
  if (!rest) return "";
  const tried = rest.not_tried.length ? `: not tried ${rest.not_tried.length === 1 ? "is" : "are"} ${rest.not_tried.map(words).join(", ")}` : "";
  return `Not finished within ${Math.round(rest.budget_s)} s of processor time${tried}. This is the best so far; another request goes on from here.`;
}

function sentence(d, adopted) {
  const span = `${d.span_s < 10 ? d.span_s.toFixed(1) : Math.round(d.span_s)} s of samples`;
  const when = d.finished ? new Date(d.finished).toLocaleString("sv-SE") : "";
  if (d.status === "idle") return "Finds out what the simulation of this drive gets wrong, from the samples of the last minute.";
  if (d.status === "running") return d.step ?? "";
  if (d.status === "failed") return `${when}: ${d.reason}`;
  if (adopted) return `${when}: ${d.result.effects.map((effect) => words(effect.name)).join(" + ")} was found, and is part of the model now.`;
  const about = `${when}, ${span}, ${named(d.model)}`;
  if (d.result.verdict === "none") return `${about}: explains the data to its noise.`;
  if (d.result.verdict === "unexplained") {
    const on = follows(d.result);
    return `${about}: something is missing that has no name here${on ? `; it follows ${on}` : ""}.`;
  }
  return `${about}: lacks what is named below${gained(d.result.gain)}.`;
}

/** One drive's; made anew when another drive is shown. */
export class DiagnosisPanel {
  constructor(drive) {
    this.drive = drive;
    this.document = null;
    this.model = []; // the drive's, as it is now
    this.waiting = null; // what the user has asked for and is not answered yet
    this.problem = "";
    this.closed = false;
    this.passed = 0; // polls since the last question
    this.diagnose = () => this.#ask("diagnosis", () => post(`${drivePath(drive)}/diagnosis`));
    this.adopt = () => this.#adopt();
    byId("diagnose").addEventListener("click", this.diagnose);
    byId("adopt").addEventListener("click", this.adopt);
    byId("diagnosis").hidden = true;
    this.figure = null;
    this.#renderUnmodelled(null);
  }

  close() {
    this.closed = true;
    byId("diagnose").removeEventListener("click", this.diagnose);
    byId("adopt").removeEventListener("click", this.adopt);
    this.#renderUnmodelled(null);
  }

  /**
   * Asks when there is reason to: a result is a large document that hardly ever changes.
   * @param {boolean} changed whether something has happened to the drive
   * @param {string[]} model the drive's effects, as they are now
   */
  async poll(changed = true, model = this.model) {
    const exchanged = model.join() !== this.model.join();
    this.model = model;
    const rests = this.document !== null && this.document.status !== "running";
    if (rests && !changed && !exchanged && ++this.passed < ASK_EVERY) return;
    this.passed = 0;
    const document = await get(`${drivePath(this.drive)}/diagnosis`);
    if (this.closed) return;
    this.document = document;
    this.#render();
  }

  #adopt() {
    const { effects } = this.document.adoption;
    const question = `Go over to the model ${named(effects)} while ${this.drive} runs? What is known of its parameters is kept.`;
    if (window.confirm(question)) {
      this.#ask("adoption", () => post(`${drivePath(this.drive)}/model`, { effects }, ADOPT_TIMEOUT_MS));
    }
  }

  async #ask(what, request) {
    this.waiting = what;
    this.problem = "";
    this.#render();
    try {
      await request();
    } catch (error) {
      this.problem = error.message;
    }
    this.waiting = null;
    if (!this.closed) this.poll().catch((error) => console.info(`diagnosis: ${error.message}`));
  }

  #render() {
    const d = this.document;
    if (d === null || this.closed) return;
    byId("diagnosis").hidden = false;
    const adopted = isAdopted(d, this.model);
    const verdict = adopted ? "adopted" : d.status === "done" ? d.result.verdict : d.status;
    byId("verdict").dataset.verdict = verdict;
    write("verdict", BADGES[verdict] ?? verdict);
    write("diagnosis-text", sentence(d, adopted));
    write("unfinished", unfinished(d));
    const running = d.status === "running";
    byId("diagnosis-progress").hidden = !running;
    if (running) byId("diagnosis-progress").value = d.progress ?? 0;
    this.#renderUnmodelled(d.status === "done" && !adopted ? (d.result.missing ?? null) : null);
    this.#renderFound(d.status === "done" && !adopted ? d.result.effects : []);
    const report = byId("report-link");
    report.hidden = d.report === null;
    if (d.report !== null) report.href = `api/v1${drivePath(this.drive)}/diagnosis/report`;
    this.#renderButtons(d, adopted);
  }

  /** Its size in words, and its curve over the speed. */
  #renderUnmodelled(missing) {
    const key = JSON.stringify(missing);
    const box = byId("unmodelled");
    if (this.unmodelled === key) return;
    this.unmodelled = key;
    charts.delete(this.figure);
    this.figure?.plot.destroy();
    const text = unmodelledText(missing);
    box.hidden = text === "";
    const figure = element("div", "", "");
    box.replaceChildren(element("p", "", text), figure);
    const plot = text ? drawUnmodelled(figure, missing) : null;
    this.figure = plot && { plot }; // drawn anew when the colours change
    if (plot) charts.add(this.figure);
  }

  /** Only when it changes, so that a text that is being selected stays. */
  #renderFound(effects) {
    const key = JSON.stringify(effects);
    if (byId("found").dataset.key === key) return;
    byId("found").dataset.key = key;
    byId("found").replaceChildren(...effects.map(foundItem));
  }

  #renderButtons(d, adopted) {
    const diagnose = byId("diagnose");
    diagnose.disabled = !d.request.allowed || this.waiting !== null;
    const adopt = byId("adopt");
    adopt.hidden = d.adoption.effects === null || adopted;
    adopt.disabled = !d.adoption.allowed || this.waiting !== null;
    adopt.textContent = this.waiting === "adoption" ? "Adopting…" : "Adopt…";
    const why = [];
    if (!d.request.allowed && d.status !== "running") why.push(`No diagnosis now: ${d.request.reason}.`);
    if (!d.adoption.allowed && d.adoption.reason && !adopted) why.push(`Nothing to adopt: ${d.adoption.reason}.`);
    write("diagnosis-why", this.problem || why.join(" "));
  }
}
