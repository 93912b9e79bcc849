// Draws the charts of a report with uPlot. Each <div class="chart"> names a JSON element that describes its panels:
// {x: {label, log}, panels: [{label, unit, log, height, range, curves: [{label, x, y, low, high, color}], image}]}.
"use strict";
(function () {
  const LIGHT = { text: "#1b1f24", grid: "#d8dde3" };
  const DARK = { text: "#dfe4ea", grid: "#3a424c" };
  const MAX_WIDTH = 700; // px: the printable width of A4
  // Anchors of a perceptually uniform color map (viridis), dark to bright.
  const MAP = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
  const plots = [];
  const scheme = window.matchMedia("(prefers-color-scheme: dark)");
  let printing = false;
  const theme = (key) => (scheme.matches && !printing ? DARK : LIGHT)[key];

  function digits(value) {
    if (value == null) return "–";
    if (!isFinite(value)) return "unbounded";
    return Math.abs(value) >= 1e5 || (value !== 0 && Math.abs(value) < 1e-3)
      ? value.toExponential(2) : String(Number(value.toPrecision(4)));
  }

  function bytes(text) {
    const raw = atob(text), out = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
    return out;
  }

  function column(values) {
    if (values.float32 === undefined) return values;
    const read = new Float32Array(bytes(values.float32).buffer);
    return Array.from(read, (value) => (isNaN(value) ? null : value));
  }

  function evenly(spaced) {
    return Array.from({ length: spaced.size }, (_, i) => spaced.start + i * spaced.step);
  }

  function abscissa(x) {
    return x.step === undefined ? column(x) : evenly(x);
  }

  // One image element of a spectrogram panel, colored by level.
  function picture(image) {
    const canvas = document.createElement("canvas");
    canvas.width = image.columns;
    canvas.height = image.rows;
    const context = canvas.getContext("2d"), pixels = context.createImageData(image.columns, image.rows);
    const levels = bytes(image.levels);
    levels.forEach((level, i) => {
      const place = (level / 255) * (MAP.length - 1), at = Math.min(Math.floor(place), MAP.length - 2);
      for (let c = 0; c < 3; c++) {
        pixels.data[4 * i + c] = MAP[at][c] + (place - at) * (MAP[at + 1][c] - MAP[at][c]);
      }
      pixels.data[4 * i + 3] = 255;
    });
    context.putImageData(pixels, 0, 0);
    return canvas;
  }

  function drawImage(plot, image, canvas) {
    const left = plot.valToPos(image.x[0], "x", true), right = plot.valToPos(image.x[1], "x", true);
    const bottom = plot.valToPos(image.y[0], "y", true), top = plot.valToPos(image.y[1], "y", true);
    const area = plot.bbox, context = plot.ctx;
    context.save();
    context.beginPath();
    context.rect(area.left, area.top, area.width, area.height);
    context.clip();
    context.imageSmoothingEnabled = false;
    context.drawImage(canvas, left, top, right - left, bottom - top);
    context.restore();
  }

  // Mantissas that are labeled on a logarithmic axis: decades; over less than two decades also values between.
  function labeledMantissas(low, high) {
    const wide = Math.log10(high / low);
    return wide > 2 ? [1] : wide > 1.2 ? [1, 2, 5] : [1, 2, 3, 5, 7];
  }

  // Ticks of a logarithmic axis; even steps if fewer than three of them would be labeled within a decade.
  function logarithmicTicks(plot, number, low, high) {
    const ticks = [], labeled = labeledMantissas(low, high);
    let count = 0;
    for (let exponent = Math.floor(Math.log10(low)); 10 ** exponent <= high; exponent++) {
      for (let mantissa = 1; mantissa < 10; mantissa++) {
        const tick = Number(`${mantissa}e${exponent}`);
        if (tick < low || tick > high) continue;
        ticks.push(tick);
        count += labeled.includes(mantissa);
      }
    }
    if (count >= 3 || high >= 10 * low) return ticks;
    const power = Math.floor(Math.log10((high - low) / 3));
    const mantissa = [5, 2, 1].find((value) => value * 10 ** power <= (high - low) / 3) ?? 1;
    const even = [];
    for (let k = Math.ceil(low / (mantissa * 10 ** power)); ; k++) {
      const tick = Number(`${k * mantissa}e${power}`);
      if (tick > high) return even;
      even.push(tick);
    }
  }

  // Labels of these ticks: the labeled mantissas, or all even steps.
  function logarithmicLabels(plot, ticks, number) {
    const scale = plot.scales[plot.axes[number].scale], labeled = labeledMantissas(scale.min, scale.max);
    const labels = ticks.map((value) => (labeled.includes(Number(value.toExponential(3).split("e")[0])) ? value : null));
    const count = labels.filter((value) => value != null).length;
    return count >= 3 || scale.max >= 10 * scale.min ? labels : ticks;
  }

  function axis(label, log, size, ticks) {
    return {
      ...(log ? { filter: logarithmicLabels, splits: logarithmicTicks } : {}), ...(ticks ? { splits: () => ticks } : {}),
      label, size, labelSize: 18, font: "12px system-ui", labelFont: "12px system-ui", gap: 3,
      stroke: () => theme("text"), grid: { stroke: () => theme("grid"), width: 1 },
      ticks: { stroke: () => theme("grid"), width: 1 },
      values: (plot, splits) => splits.map((value) => (value == null ? "" : digits(value))),
      space: log ? 34 : 45,
    };
  }

  function range(log, given) {
    if (given) return () => given;
    return (plot, low, high) => {
      if (low == null) return log ? [0.1, 10] : [-1, 1];
      if (low === high && !log) return [low - 1, high + 1];
      return log ? [low / 1.15, high * 1.15] : [low - 0.05 * (high - low), high + 0.05 * (high - low)];
    };
  }

  function series(panel) {
    const shown = [], bands = [];
    for (const curve of panel.curves) {
      const main = shown.length + 1;
      shown.push({
        label: curve.label, stroke: curve.color, width: 1.4, spanGaps: false,
        points: { show: curve.x.length !== undefined && curve.x.length <= 160, size: 4, fill: curve.color },
        value: (plot, value, k, i) => {
          if (value == null) return "–";
          const high = curve.high && i != null ? plot.data[main + 2][i] : null;
          const bound = high == null ? "" : ` ± ${digits(high - value)}`;
          return `${digits(value)}${bound} ${panel.unit}`;
        },
      });
      if (!curve.low) continue;
      for (const edge of ["low", "high"]) {
        shown.push({ label: `${curve.label} ${edge}`, class: "bound", stroke: "transparent", points: { show: false } });
      }
      bands.push({ series: [main + 2, main + 1], fill: curve.color + "33" });
    }
    return { shown, bands };
  }

  function table(panel) {
    const tables = panel.curves.map((curve) => {
      const rows = [abscissa(curve.x), column(curve.y)];
      return curve.low ? [...rows, column(curve.low), column(curve.high)] : rows;
    });
    if (!tables.length) return [panel.image.x];
    return tables.length === 1 ? tables[0] : uPlot.join(tables);
  }

  function draw(holder, chart, number) {
    const width = Math.min(holder.clientWidth, MAX_WIDTH);
    chart.panels.forEach((panel, k) => {
      const last = k === chart.panels.length - 1, { shown, bands } = series(panel);
      const canvas = panel.image ? picture(panel.image) : null;
      const plot = new uPlot({
        width, height: panel.height + (last ? 20 : 0),
        scales: {
          x: { time: false, distr: chart.x.log ? 3 : 1, range: (u, low, high) => [low, high] },
          y: { distr: panel.log ? 3 : 1, range: range(panel.log, panel.range) },
        },
        axes: [axis(last ? chart.x.label : "", chart.x.log, last ? 34 : 20), axis(panel.label, panel.log, 58, panel.ticks)],
        series: [{ label: chart.x.name, value: (u, v) => (v == null ? "–" : `${Number(v.toPrecision(6))} ${chart.x.unit}`) }, ...shown],
        bands,
        cursor: { sync: { key: `chart${number}`, setSeries: true, scales: ["x", null] }, drag: { x: true, y: false } },
        legend: { show: panel.curves.length > 0 },
        hooks: canvas ? { drawClear: [(u) => drawImage(u, panel.image, canvas)] } : {},
      }, table(panel), holder);
      plots.push({ plot, holder });
    });
    holder.dataset.drawn = chart.panels.length;
  }

  function redraw() {
    for (const { plot } of plots) plot.redraw(false, true);
  }

  function resize() {
    for (const { plot, holder } of plots) {
      const width = Math.min(holder.clientWidth, MAX_WIDTH);
      if (width !== plot.width) plot.setSize({ width, height: plot.height });
    }
  }

  document.querySelectorAll(".chart").forEach((holder, number) => {
    draw(holder, JSON.parse(document.getElementById(holder.dataset.source).textContent), number);
  });
  window.addEventListener("resize", resize);
  scheme.addEventListener("change", redraw);
  // Paper shows the scene files, which repeat the test.
  const showDetails = (open) => document.querySelectorAll("details").forEach((details) => { details.open = open; });
  window.addEventListener("beforeprint", () => { printing = true; showDetails(true); redraw(); });
  window.addEventListener("afterprint", () => { printing = false; showDetails(false); redraw(); });
})();
