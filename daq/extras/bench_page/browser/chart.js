// A chart on a canvas: panels above each other with a common abscissa. A value of NaN is a gap in a curve.
"use strict";

const AMBER = "#ffc53d"; // limits, and bounds instead of values
const COLORS = { text: "#cfd6de", grid: "#323b46", minor: "#232a32", frame: "#4a5562" };
const FEW = 6; // A curve with fewer points shows tones.
const MARK = 5, MARK_STEP = 3; // radius of the mark of a tone, and its step between curves, whose marks may coincide, px
const LEFT = 54, RIGHT = 8, TOP = 8, BOTTOM = 32, GAP = 13; // px

class Chart {
  // `x`: {name, log}; panels are {name, log, share, range, smallest, curves: [{x, y, color, dash, dots, mark, arrows, width}]}.
  constructor(canvas, x) {
    Object.assign(this, { canvas, x, panels: [], range: [1, 10], cursors: [] });
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  show(range, panels) {
    [this.range, this.panels] = [range, panels];
    this.draw();
  }

  position(value) {
    const [low, high] = this.range;
    const fraction = this.x.log ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low);
    return LEFT + fraction * (this.width - LEFT - RIGHT);
  }

  value(pixel) {
    const [low, high] = this.range, fraction = (pixel - LEFT) / (this.width - LEFT - RIGHT);
    return this.x.log ? low * (high / low) ** fraction : low + fraction * (high - low);
  }

  draw() {
    const { canvas } = this, ratio = window.devicePixelRatio || 1;
    [this.width, this.height] = [canvas.clientWidth, canvas.clientHeight];
    if (!this.width || !this.height) return;
    if (canvas.width !== Math.round(this.width * ratio) || canvas.height !== Math.round(this.height * ratio)) {
      [canvas.width, canvas.height] = [Math.round(this.width * ratio), Math.round(this.height * ratio)];
    }
    const context = (this.context = canvas.getContext("2d"));
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, this.width, this.height);
    context.font = "11px system-ui, sans-serif";
    context.lineJoin = "round"; // A mitred join rises above its point.
    const free = this.height - TOP - BOTTOM - GAP * (this.panels.length - 1);
    const shares = this.panels.reduce((sum, panel) => sum + (panel.share ?? 1), 0);
    let top = TOP;
    for (const panel of this.panels) {
      const height = (free * (panel.share ?? 1)) / shares;
      this.drawPanel(panel, top, height);
      top += height + GAP;
    }
    this.drawAbscissa(top - GAP);
    for (const [k, x] of this.cursors.entries()) this.drawCursor(x, "AB"[k], top - GAP);
  }

  drawPanel(panel, top, height) {
    const { context } = this, right = this.width - RIGHT, [low, high] = (panel.range ??= limits(panel));
    const y = (value) => {
      const fraction = panel.log ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low);
      return top + height * (1 - fraction);
    };
    context.textAlign = "right";
    context.textBaseline = "middle";
    // A low panel has a label at every second of its fixed ticks.
    const every = panel.ticks && height / panel.ticks.length < 13 ? 2 : 1;
    for (const [k, [value, isLabeled]] of (panel.ticks ?? ticks(low, high, height, panel.log, 26)).entries()) {
      const labeled = isLabeled && !(panel.ticks && (panel.ticks.length - 1 - k) % every);
      line(context, LEFT, y(value), right, y(value), labeled ? COLORS.grid : COLORS.minor);
      if (labeled && y(value) > top - 1 && y(value) < top + height + 1) text(context, digits(value), LEFT - 5, y(value));
    }
    for (const [value, labeled] of ticks(...this.range, right - LEFT, this.x.log)) if (labeled || !this.x.log) line(context, this.position(value), top, this.position(value), top + height, COLORS.grid);
    context.strokeStyle = COLORS.frame;
    context.strokeRect(LEFT, top, right - LEFT, height);
    context.save();
    context.beginPath();
    context.rect(LEFT, top, right - LEFT, height);
    context.clip();
    for (const curve of panel.curves) this.drawCurve(curve, y);
    context.restore();
    context.save();
    context.translate(9, top + height / 2);
    context.rotate(-Math.PI / 2);
    context.textAlign = "center";
    // The names of low panels are small, or units, so that they do not touch.
    if (context.measureText(panel.name).width > height) context.font = "10px system-ui, sans-serif";
    text(context, context.measureText(panel.name).width > height + 2 * GAP ? panel.name.split(" / ").at(-1) : panel.name, 0, 0);
    context.restore();
  }

  drawCurve({ x, y, color, dash = [], width = 1.4, opacity = 1, dots = false, mark = 0, arrows = [] }, toPixel) {
    const { context } = this, isGap = (k) => k < 0 || k >= y.length || !isFinite(y[k]);
    context.strokeStyle = context.fillStyle = color;
    [context.lineWidth, context.globalAlpha] = [width, opacity];
    context.setLineDash(dash);
    context.beginPath();
    // The points of a few tones are larger than those among lines, and hollow: circle, square, triangle.
    const isFew = y.filter((value) => isFinite(value)).length < FEW, sides = [32, 4, 3, 6, 5][mark % 5], radius = MARK + MARK_STEP * (mark % 5);
    for (let k = 0; k < y.length; k++) {
      if (isGap(k)) continue;
      const px = this.position(x[k]), py = toPixel(y[k]);
      for (const side of arrows) {
        context.moveTo(px, py);
        for (const [dx, dy] of [[0, 14], [-4, 9], [0, 14], [4, 9]]) context.lineTo(px + dx, py - side * dy);
      }
      if (isGap(k - 1)) context.moveTo(px, py);
      else context.lineTo(px, py);
      if (!dots || !isGap(k - 1) || !isGap(k + 1)) continue;
      if (!isFew) context.rect(px - 1, py - 1, 2, 2);
      for (let j = 0; isFew && j <= sides; j++) {
        const angle = (2 * Math.PI * (j + (sides === 4) / 2)) / sides;
        context[j ? "lineTo" : "moveTo"](px + radius * Math.sin(angle), py - radius * Math.cos(angle));
      }
    }
    context.stroke();
    context.setLineDash([]);
    context.lineWidth = context.globalAlpha = 1;
  }

  drawAbscissa(bottom) {
    const { context } = this, right = this.width - RIGHT;
    context.textAlign = "center";
    context.textBaseline = "top";
    for (const [value, labeled] of ticks(...this.range, right - LEFT, this.x.log)) {
      if (labeled) text(context, digits(value), Math.min(this.position(value), right - 6), bottom + 4);
    }
    text(context, this.x.name, (LEFT + right) / 2, bottom + 18);
  }

  drawCursor(x, name, bottom) {
    if (x == null || x < this.range[0] || x > this.range[1]) return;
    const pixel = this.position(x);
    line(this.context, pixel, TOP, pixel, bottom, "#ffffff", [4, 3]);
    this.context.textAlign = "left";
    this.context.textBaseline = "top";
    text(this.context, name, pixel + 3, TOP + 2);
  }
}

// Limits of a panel: symmetric on a linear axis, at most five decades on a logarithmic one.
function limits(panel) {
  let low = Infinity, high = -Infinity;
  for (const { y } of panel.curves) {
    for (const value of y) {
      if (!isFinite(value) || (panel.log && value <= 0)) continue;
      if (value < low) low = value;
      if (value > high) high = value;
    }
  }
  if (panel.log) {
    if (high < low) return [1, 1000];
    return [roundUp(Math.max(low, high * 1e-5)) / 2.5, roundUp(high * 1.1)];
  }
  const largest = roundUp(Math.max(panel.smallest, -low, high, 1e-12));
  return [-largest, largest];
}

function line(context, x0, y0, x1, y1, color, dash = []) {
  context.strokeStyle = color;
  context.setLineDash(dash);
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1, y1);
  context.stroke();
  context.setLineDash([]);
}

function text(context, string, x, y) {
  context.fillStyle = COLORS.text;
  context.fillText(string.replace(/^-/, "−"), x, y);
}
