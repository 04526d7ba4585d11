// Ways to zoom beside dragging with the mouse: buttons, keys, a finger; and figures that zoom together.

/** The part of the x axis from `from` to `to`, in parts of what is visible: −0.5, 1.5 is twice as much. */
function part(figure, from, to) {
  const { plot, ends } = figure;
  const width = plot.over.clientWidth;
  const low = plot.posToVal(from * width, "x");
  const high = plot.posToVal(to * width, "x");
  if (from < 0 && to > 1) figure.show(Math.max(low, ends[0]), Math.min(high, ends[1]), heightPart(figure, from, to));
  else if (low < ends[0]) part(figure, ...shifted(figure, ends[0], null));
  else if (high > ends[1]) part(figure, ...shifted(figure, null, ends[1]));
  else figure.show(low, high, heightPart(figure, from, to));
}

/** What is visible, moved to where it meets an end of the axis. */
function shifted(figure, low, high) {
  const { plot } = figure;
  const width = plot.over.clientWidth;
  const by = low === null ? Math.floor(plot.valToPos(high, "x") - width) : Math.ceil(plot.valToPos(low, "x"));
  return [by / width, 1 + by / width];
}

/** A scatter zooms in both directions. */
function heightPart(figure, from, to) {
  if (figure.spec.kind !== "scatter" || to - from === 1) return null;
  const height = figure.plot.over.clientHeight;
  return [figure.plot.posToVal(to * height, "y"), figure.plot.posToVal(from * height, "y")];
}

const ACTIONS = {
  in: (figure) => part(figure, 0.25, 0.75),
  out: (figure) => part(figure, -0.5, 1.5),
  left: (figure) => part(figure, -0.25, 0.75),
  right: (figure) => part(figure, 0.25, 1.25),
  whole: (figure) => figure.whole(),
};
const KEYS = { "+": "in", "=": "in", "-": "out", ArrowLeft: "left", ArrowRight: "right", 0: "whole", Escape: "whole" };

function handleKeys(figure) {
  figure.box.addEventListener("keydown", (event) => {
    const action = KEYS[event.key];
    if (!action || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    ACTIONS[action](figure);
  });
  for (const button of figure.element.querySelectorAll("[data-zoom]"))
    button.addEventListener("click", () => ACTIONS[button.dataset.zoom](figure));
}

/** A finger drawn sideways selects as the mouse does (upwards it scrolls the page); a double tap shows the whole. */
function handleTouch(figure) {
  const { over } = figure.plot;
  let start = null;
  const left = (event) => Math.min(Math.max(event.clientX - over.getBoundingClientRect().left, 0), over.clientWidth);
  const select = (from, to) =>
    figure.plot.setSelect({ left: Math.min(from, to), width: Math.abs(to - from), top: 0, height: from === to ? 0 : over.clientHeight }, false);
  over.addEventListener("pointerdown", (event) => {
    if (event.pointerType === "touch" && event.isPrimary) start = left(event);
  });
  over.addEventListener("pointermove", (event) => {
    if (start !== null && event.pointerType === "touch") select(start, left(event));
  });
  const end = (event) => {
    if (start === null || event.pointerType !== "touch") return;
    const [from, to] = [start, left(event)].sort((a, b) => a - b);
    start = null;
    select(0, 0);
    if (event.type === "pointerup" && to - from > 12)
      figure.show(figure.plot.posToVal(from, "x"), figure.plot.posToVal(to, "x"));
  };
  for (const type of ["pointerup", "pointercancel"]) over.addEventListener(type, end);
}

/** Figures of one group show the same part of x, and together the whole of what any of them has. */
function link(figures) {
  const groups = new Map();
  for (const figure of figures) {
    const name = figure.spec.group;
    if (name) groups.set(name, [...(groups.get(name) ?? []), figure]);
  }
  for (const group of groups.values()) {
    const ends = [Math.min(...group.map((f) => f.ends[0])), Math.max(...group.map((f) => f.ends[1]))];
    for (const figure of group) {
      figure.ends = ends;
      figure.show(...ends);
    }
    for (const figure of group) figure.onRange = (min, max) => group.forEach((f) => f !== figure && f.show(min, max));
  }
}
