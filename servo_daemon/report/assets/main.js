// Draws every figure of the document and follows width, colour scheme and printing.

const PRINTED_WIDTH = 660; // px on a sheet of A4 with its margins

const { figures: specs } = JSON.parse(document.getElementById("data").textContent);
const figures = specs.map((spec, k) => new Figure(document.getElementById(`f${k + 1}`), spec));
link(figures);

for (const figure of figures) {
  handleKeys(figure);
  handleTouch(figure);
  new ResizeObserver(() => {
    if (figure.box.clientWidth !== figure.plot.width) figure.resize();
  }).observe(figure.box);
}

const redraw = () => figures.forEach((figure) => figure.plot.redraw(false, true));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);

addEventListener("beforeprint", () => {
  root.classList.add("printed");
  for (const figure of figures) figure.resize(PRINTED_WIDTH);
  redraw();
});
addEventListener("afterprint", () => {
  root.classList.remove("printed");
  for (const figure of figures) figure.resize();
  redraw();
});
root.classList.add("drawn");
