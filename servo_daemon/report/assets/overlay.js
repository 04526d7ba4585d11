// What is drawn beside the data: shaded spans, marks and levels with their labels.

const FONT_SIZE = 11;
const font = (ratio) => `${FONT_SIZE * ratio}px system-ui, sans-serif`;

function clipped(plot, draw) {
  const { ctx, bbox } = plot;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  ctx.font = font(uPlot.pxRatio);
  draw(ctx, bbox, uPlot.pxRatio);
  ctx.restore();
}

/** The visible part of a span, in pixels of the canvas. */
const edges = (plot, bbox, start, stop) => [
  Math.max(plot.valToPos(start, "x", true), bbox.left),
  Math.min(plot.valToPos(stop, "x", true), bbox.left + bbox.width),
];

function drawSpans(plot, spans) {
  clipped(plot, (ctx, bbox) => {
    for (const [start, stop] of spans) {
      const [left, right] = edges(plot, bbox, start, stop);
      if (right <= left) continue;
      ctx.fillStyle = colour("--span");
      ctx.fillRect(left, bbox.top, right - left, bbox.height);
    }
  });
}

/** Text on a ground of its own, so that it is read on top of any line. */
function label(ctx, text, x, y, ratio) {
  const width = ctx.measureText(text).width;
  ctx.fillStyle = colour("--label-ground");
  ctx.fillRect(x - 2 * ratio, y, width + 4 * ratio, (FONT_SIZE + 3) * ratio);
  ctx.fillStyle = colour("--mark");
  ctx.textAlign = "left";
  ctx.textBaseline = "top";
  ctx.fillText(text, x, y + 1 * ratio);
}

/** Names of the spans at the bottom of the figure, where they fit. */
function drawSpanLabels(plot, spans) {
  clipped(plot, (ctx, bbox, ratio) => {
    for (const [start, stop, text] of spans) {
      const [left, right] = edges(plot, bbox, start, stop);
      const width = ctx.measureText(text).width;
      if (width > right - left - 8 * ratio) continue;
      label(ctx, text, (left + right - width) / 2, bbox.top + bbox.height - (FONT_SIZE + 6) * ratio, ratio);
    }
  });
}

function stroke(ctx, from, to, ratio) {
  ctx.strokeStyle = colour("--mark");
  ctx.lineWidth = ratio;
  ctx.setLineDash([4 * ratio, 3 * ratio]);
  ctx.beginPath();
  ctx.moveTo(...from);
  ctx.lineTo(...to);
  ctx.stroke();
}

/** Vertical lines; labels that would cover each other go to a row below, at most ROWS of them. */
function drawMarks(plot, marks) {
  const ROWS = 4;
  clipped(plot, (ctx, bbox, ratio) => {
    const ends = new Array(ROWS).fill(-Infinity);
    const right = bbox.left + bbox.width;
    for (const [at, text] of [...marks].sort((a, b) => a[0] - b[0])) {
      const x = Math.round(plot.valToPos(at, "x", true)) + 0.5;
      if (!(x >= bbox.left && x <= right)) continue;
      stroke(ctx, [x, bbox.top], [x, bbox.top + bbox.height], ratio);
      const width = ctx.measureText(text).width;
      const start = x + 4 * ratio + width > right ? x - 4 * ratio - width : x + 4 * ratio;
      const row = ends.findIndex((end) => end < start - 4 * ratio);
      if (row < 0) continue;
      ends[row] = start + width;
      label(ctx, text, start, bbox.top + (2 + row * (FONT_SIZE + 4)) * ratio, ratio);
    }
  });
}

/** Horizontal lines, their labels at the right end, above the line where there is room. */
function drawLevels(plot, levels) {
  clipped(plot, (ctx, bbox, ratio) => {
    for (const [at, text] of levels) {
      const y = Math.round(plot.valToPos(at, "y", true)) + 0.5;
      if (!(y >= bbox.top && y <= bbox.top + bbox.height)) continue;
      stroke(ctx, [bbox.left, y], [bbox.left + bbox.width, y], ratio);
      const height = (FONT_SIZE + 4) * ratio;
      const top = y - height > bbox.top ? y - height : y + 2 * ratio;
      label(ctx, text, bbox.left + bbox.width - ctx.measureText(text).width - 4 * ratio, top, ratio);
    }
  });
}
