// What is drawn over a chart's curves: nominal value and limits as lines, RF+GRNN as diamonds, events as triangles below.
/* global uPlot */

const style = getComputedStyle(document.documentElement);
export const colour = (name) => () => style.getPropertyValue(name).trim();

/**
 * Thin lines across the chart; of one that is outside an arrow that says where it would be.
 * @param {{name: string, value: number, colour: string, dash?: number[]}[]} lines in the chart's unit
 */
export function drawLines(plot, lines) {
  const { ctx, bbox } = plot;
  const { min, max } = plot.scales.y;
  const ratio = uPlot.pxRatio;
  const outside = { "↑": 0, "↓": 0 };
  ctx.save();
  ctx.font = `${11 * ratio}px system-ui, sans-serif`;
  ctx.textAlign = "right";
  ctx.lineWidth = ratio;
  for (const line of lines) {
    ctx.strokeStyle = ctx.fillStyle = colour(line.colour)();
    const right = bbox.left + bbox.width;
    if (line.value >= min && line.value <= max) {
      const y = Math.round(plot.valToPos(line.value, "y", true)) + 0.5;
      ctx.setLineDash((line.dash ?? []).map((length) => length * ratio));
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(right, y);
      ctx.stroke();
      const below = y - bbox.top < 16 * ratio;
      ctx.textBaseline = below ? "top" : "bottom";
      if (line.dash) ctx.fillText(line.name, right - 4 * ratio, y + (below ? 2 : -2) * ratio);
      continue;
    }
    const arrow = line.value > max ? "↑" : "↓";
    const away = (3 + 13 * outside[arrow]++) * ratio;
    ctx.textBaseline = arrow === "↑" ? "top" : "bottom";
    ctx.fillText(`${line.name} ${arrow}`, right - 4 * ratio, arrow === "↑" ? bbox.top + away : bbox.top + bbox.height - away);
  }
  ctx.restore();
}

/** What the learned model said of its windows: {time, value, std, applied}. */
export function drawMarks(plot, marks) {
  const { ctx, bbox, scales } = plot;
  const size = 4 * uPlot.pxRatio;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  ctx.setLineDash([]); // as the last line left it
  ctx.strokeStyle = ctx.fillStyle = colour("--learned")();
  for (const mark of marks) {
    if (mark.time < scales.x.min || mark.time > scales.x.max) continue;
    const x = plot.valToPos(mark.time, "x", true);
    const at = (value) => plot.valToPos(value, "y", true);
    ctx.globalAlpha = 0.4;
    ctx.lineWidth = uPlot.pxRatio;
    ctx.beginPath();
    ctx.moveTo(x, at(mark.value - 2 * mark.std));
    ctx.lineTo(x, at(mark.value + 2 * mark.std));
    ctx.stroke();
    const y = at(mark.value);
    ctx.globalAlpha = 1;
    ctx.lineWidth = 1.5 * uPlot.pxRatio;
    ctx.beginPath();
    ctx.moveTo(x, y - size);
    ctx.lineTo(x + size, y);
    ctx.lineTo(x, y + size);
    ctx.lineTo(x - size, y);
    ctx.closePath();
    if (mark.applied) ctx.fill();
    else ctx.stroke();
  }
  ctx.restore();
}

/** Events as triangles on the axis of time; those that warn are red. A click near one opens it. */
export function drawEvents(plot, events) {
  const { ctx, bbox, scales } = plot;
  const size = 5 * uPlot.pxRatio;
  const bottom = bbox.top + bbox.height;
  ctx.save();
  for (const { time, warns } of events) {
    if (time < scales.x.min || time > scales.x.max) continue;
    const x = plot.valToPos(time, "x", true);
    ctx.fillStyle = colour(warns ? "--bad" : "--nominal")();
    ctx.beginPath();
    ctx.moveTo(x - size, bottom);
    ctx.lineTo(x + size, bottom);
    ctx.lineTo(x, bottom - 1.6 * size);
    ctx.closePath();
    ctx.fill();
  }
  ctx.restore();
}
