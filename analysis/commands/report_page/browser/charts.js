// Draws the charts of a report with uPlot. Each <div class="chart"> names a JSON element that describes its panels:
// {x: {label, log, range}, panels: [{label, title, unit, log, height, range, curves: [{label, x, y, low, high, color, dash, marker, draw}], image}]}.
"use strict";
(function () {
  const LIGHT = { text: "#1b1f24", grid: "#d8dde3", page: "#ffffff" };
  const DARK = { text: "#dfe4ea", grid: "#3d4752", page: "#14181d" };
  // Grays of undetermined curves and of the baseline of a comparison in the data, and on a dark page.
  const GRAYS = { "#9aa2ab": "#98a3af", "#404040": "#f2f4f7" };
  const PRINT_WIDTH = 840; // px of the printable width of A4 (188 mm): labels of 12 px have 7.6 pt, less than titles
  // Printed height of a panel relative to its height on screen: two charts of a tall and three low panels fit on a page.
  const printHeight = (panel) => panel.height * (panel.height < 220 ? 0.76 : 0.77);
  const MIN_CONTRAST = 6; // of curves on a dark page: they are thinner than text, for which WCAG requires 4.5
  const MIN_DECADE = 120; // px: a shorter decade has no grid lines between its ends
  const MIN_LABEL = 14, MIN_LABEL_WIDTH = 34; // px between labels of a vertical and of a horizontal logarithmic axis
  const MANTISSAS = [[1, 1.5, 2, 3, 4, 5, 6, 8], [1, 2, 3, 4, 5, 6, 8], [1, 2, 3, 5, 7], [1, 2, 5], [1, 3]];
  const LABEL_ROW = 14, LABEL_ROWS = 3; // px, and the largest number of rows of labels for which a panel is higher
  const POINT = () => (window.innerWidth < 700 && !printing ? 3.4 : 5); // px: points of tones must not touch
  const SYMBOLS = ["dots", "crosses", "circles", "diamonds", "arrows", "limits", "path"]; // drawn over the series, in any order of the abscissa
  const FONT = "12px system-ui, sans-serif";
  // Anchors of a perceptually uniform color map (viridis), dark to bright.
  const MAP = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
  const plots = [], paints = [], measure = document.createElement("canvas").getContext("2d");
  const scheme = window.matchMedia("(prefers-color-scheme: dark)");
  let printing = false;
  const isDark = () => scheme.matches && !printing;
  const theme = (key) => (isDark() ? DARK : LIGHT)[key];
  const channels = (color) => [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16));
  const luminance = (color) => channels(color).map((value) => value / 255)
    .map((value) => (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4))
    .reduce((sum, value, k) => sum + [0.2126, 0.7152, 0.0722][k] * value, 0);

  // On a dark page a color is lightened until its contrast is sufficient; undetermined curves are dim on any page.
  function shade(color) {
    if (isDark() && color in GRAYS) return GRAYS[color];
    while (isDark() && (luminance(color) + 0.05) / (luminance(DARK.page) + 0.05) < MIN_CONTRAST) {
      color = `#${channels(color).map((value) => Math.round(value + 0.1 * (255 - value)).toString(16).padStart(2, "0")).join("")}`;
    }
    return color;
  }

  function digits(value) {
    if (value == null) return "–";
    if (!isFinite(value)) return "unbounded";
    return Math.abs(value) >= 1e5 || (value !== 0 && Math.abs(value) < 1e-3)
      ? value.toExponential(2) : String(Number(value.toPrecision(4)));
  }

  // Text of a tick; large and small numbers are powers of ten, which are short.
  function tick(value) {
    if (value === 0 || (Math.abs(value) < 1e5 && Math.abs(value) >= 1e-3)) return digits(value).replace("-", "−");
    const [mantissa, exponent] = value.toExponential().split("e");
    const power = `10${[...String(Number(exponent))].map((sign) => (sign === "-" ? "⁻" : "⁰¹²³⁴⁵⁶⁷⁸⁹"[sign])).join("")}`;
    return mantissa === "1" ? power : `${Number(Number(mantissa).toPrecision(3))}·${power}`;
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

  const PATHS = {
    dots: (context, x, y, r) => { context.arc(x, y, 0.9 * r, 0, 7); },
    crosses: (context, x, y, r) => { context.moveTo(x - r, y - r); context.lineTo(x + r, y + r); context.moveTo(x - r, y + r); context.lineTo(x + r, y - r); },
    circles: (context, x, y, r) => { context.arc(x, y, 1.2 * r, 0, 7); },
    diamonds: (context, x, y, r) => { context.moveTo(x, y - 1.6 * r); for (const [dx, dy] of [[1, 0], [0, 1], [-1, 0], [0, -1]]) context.lineTo(x + 1.6 * dx * r, y + 1.6 * dy * r); },
    squares: (context, x, y, r) => { context.rect(x - 0.9 * r, y - 0.9 * r, 1.8 * r, 1.8 * r); },
    limits: (context, x, y, r) => { context.moveTo(x - 1.2 * r, y - r); context.lineTo(x + 1.2 * r, y - r); context.lineTo(x, y + 1.2 * r); context.closePath(); },
    arrows: (context, x, y, r) => {
      context.moveTo(x, y - 2 * r); context.lineTo(x, y - 6 * r);
      context.moveTo(x - r, y - 4.5 * r); context.lineTo(x, y - 6 * r); context.lineTo(x + r, y - 4.5 * r);
    },
  };

  // The labels of peaks in view, each with its center: a row for each color, in which labels move sideways until they do
  // not overlap. Labels that exceed the width begin another row.
  function labelsOf(plot, panel, left, right) {
    const { min, max } = plot.scales.x, rows = [];
    measure.font = FONT;
    for (const [x, y, label, color] of [...panel.marks].filter(([at]) => at >= min && at <= max).sort((a, b) => a[0] - b[0])) {
      const half = measure.measureText(label).width / 2 + 4;
      const ends = (row) => row.reduce((sum, other) => sum + 2 * other.half, 2 * half) <= left + right;
      let row = rows.find((labels) => labels[0].color === color && ends(labels));
      if (!row) rows.push(row = []);
      row.push({ x, y, label, color, half, center: Math.max(plot.valToPos(x, "x"), half - left) });
    }
    const order = panel.marks.map(([, , , color]) => color);
    rows.sort((a, b) => order.indexOf(a[0].color) - order.indexOf(b[0].color));
    for (const row of rows) {
      row.forEach((each, k) => { if (k) each.center = Math.max(each.center, row[k - 1].center + row[k - 1].half + each.half); });
      row.reduceRight((limit, each) => (each.center = Math.min(each.center, limit - each.half)) - each.half, right);
    }
    return rows.flatMap((row, k) => row.map((each) => ({ ...each, row: k })));
  }

  // Strips at the axis where the values are undetermined, symbols, and labels of peaks above the axes.
  function annotate(plot, panel) {
    const context = plot.ctx, { left, top, width, height } = plot.bbox, ratio = window.devicePixelRatio || 1;
    const inside = (x) => Math.min(Math.max(x, left), left + width);
    const position = (x, y) => [plot.valToPos(x, "x", true), plot.valToPos(y, "y", true)];
    context.save();
    const owners = [...new Set(panel.strips.map(({ color }) => color))];
    for (const { ends, color } of panel.strips) {
      const [low, high] = ends.map((x) => inside(plot.valToPos(x, "x", true)));
      context.fillStyle = shade(color);
      context.globalAlpha = isDark() ? 0.6 : 0.4; // paler than the curves, and still in their colors
      context.fillRect(low, top + height - 5 * (owners.indexOf(color) + 1) * ratio, high - low, 5 * ratio);
    }
    context.globalAlpha = 1;
    if (panel.title) {
      context.font = `600 ${12 * ratio}px system-ui, sans-serif`;
      context.fillStyle = theme("page");
      context.fillRect(left + 6 * ratio, top + 3 * ratio, context.measureText(panel.title).width + 6 * ratio, 16 * ratio);
      context.fillStyle = theme("text");
      context.textAlign = "left";
      context.fillText(panel.title, left + 9 * ratio, top + 15 * ratio);
    }
    for (const curve of panel.curves.filter(({ draw }) => SYMBOLS.includes(draw))) {
      if (curve.hidden) continue;
      context.lineWidth = 1.3 * ratio;
      context.strokeStyle = shade(curve.color);
      context.fillStyle = curve.draw === "dots" ? shade(curve.color) : theme("page");
      context.beginPath();
      curve.x.forEach((value, i) => {
        if (curve.draw === "path") context.lineTo(...position(value, curve.y[i]));
        if (!curve.low) return;
        context.moveTo(...position(value, curve.low[i]));
        context.lineTo(...position(value, curve.high[i]));
      });
      context.globalAlpha = 0.8;
      // A path only joins its points: nothing is measured between them.
      if (curve.draw === "path") context.setLineDash([1.5 * ratio, 2.5 * ratio]);
      context.stroke();
      context.setLineDash([]);
      context.globalAlpha = 1;
      if (curve.draw === "path") continue;
      context.beginPath();
      curve.x.forEach((value, i) => {
        const [x, y] = position(value, curve.y[i]), r = ((curve.draw === "circles" ? 3.2 : 3) * ratio * POINT()) / 5;
        if (curve.y[i] == null || x < left || x > left + width || y < top || y > top + height) return;
        context.moveTo(x + (curve.draw === "dots" ? 0.9 : 1.2) * r, y);
        PATHS[curve.draw](context, x, y, r);
      });
      if (["dots", "circles", "diamonds", "limits"].includes(curve.draw)) context.fill();
      context.stroke();
    }
    context.lineWidth = 0.6 * ratio;
    context.font = `${12 * ratio}px system-ui, sans-serif`;
    context.textAlign = "center";
    const marks = labelsOf(plot, panel, left / ratio, width / ratio).map((mark) => ({ ...mark, base: top - (6 + LABEL_ROW * mark.row) * ratio }));
    context.setLineDash([2 * ratio, 3 * ratio]);
    context.globalAlpha = 0.6;
    for (const { x, y, color, base, center } of marks) {
      const [px, py] = position(x, y);
      context.strokeStyle = color ? shade(color) : theme("text");
      context.beginPath();
      context.moveTo(left + center * ratio, base);
      context.lineTo(px, top);
      context.lineTo(px, Math.max(py - 8 * ratio, top));
      context.stroke();
    }
    context.globalAlpha = 1;
    // Labels interrupt the lines of the labels above them.
    for (const { label, color, center, base } of marks) {
      const half = context.measureText(label).width / 2;
      context.fillStyle = theme("page");
      context.fillRect(left + center * ratio - half, base - 11 * ratio, 2 * half, 14 * ratio);
      context.fillStyle = color ? shade(color) : theme("text");
      context.fillText(label, left + center * ratio, base);
    }
    context.restore();
  }

  // Mantissas that are labeled on a logarithmic axis: decades; over two decades, or if fewer than three decades are in
  // view, also values between that leave space between their labels.
  function labeledMantissas(plot, number) {
    const { min, max } = plot.scales[plot.axes[number].scale], space = number ? MIN_LABEL : MIN_LABEL_WIDTH;
    const fits = (set) => set.every((value, k) => decade(plot, number) * Math.log10((set[k + 1] ?? 10) / value) >= space);
    const decades = Math.floor(Math.log10(max)) - Math.ceil(Math.log10(min)) + 1;
    return ((max <= 100 * min || decades < 3) && MANTISSAS.find(fits)) || [1];
  }

  // Length of a decade of a logarithmic axis, px.
  function decade(plot, number) {
    const { min, max } = plot.scales[plot.axes[number].scale];
    const { width, height } = plot.bbox;
    const length = (number ? height : width) / window.devicePixelRatio || (number ? plot.height : plot.width);
    return length / Math.log10(max / min);
  }

  // Ticks of a logarithmic axis; even steps if fewer than three of them would be labeled within a decade.
  function logarithmicTicks(plot, number, low, high) {
    const ticks = [], labeled = labeledMantissas(plot, number);
    const drawn = decade(plot, number) < MIN_DECADE ? labeled : [1, ...(labeled.includes(1.5) ? [1.5] : []), 2, 3, 4, 5, 6, 7, 8, 9];
    let count = 0;
    for (let exponent = Math.floor(Math.log10(low)); 10 ** exponent <= high; exponent++) {
      for (const mantissa of drawn) {
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
    const scale = plot.scales[plot.axes[number].scale], labeled = labeledMantissas(plot, number);
    const every = labeled.length > 1 ? 1 : Math.ceil(MIN_LABEL / decade(plot, number));
    const labels = ticks.map((value) => {
      const [mantissa, exponent] = value.toExponential(3).split("e").map(Number);
      return labeled.includes(mantissa) && exponent % every === 0 ? value : null;
    });
    const count = labels.filter((value) => value != null).length;
    return count >= 3 || scale.max >= 10 * scale.min ? labels : ticks;
  }

  // An axis with a title, or without title and labels if `size` is small.
  function axis(label, log, size, space, ticks) {
    return {
      ...(log ? { filter: logarithmicLabels, splits: logarithmicTicks } : {}),
      // Printed panels are too low for all of many ticks; three labels remain.
      ...(ticks ? { splits: () => ticks.filter((_, k) => !printing || ticks.length < 5 || (ticks.length - 1 - k) % 2 === 0) } : {}),
      ...(label ? { label, labelSize: 18, labelFont: FONT } : {}), size, font: FONT, gap: 3,
      stroke: () => theme("text"), grid: { stroke: () => theme("grid"), width: 1 },
      ticks: { stroke: () => theme("grid"), width: 1, size: label ? 6 : 0 },
      values: (plot, splits) => splits.map((value) => (value == null || !label ? "" : tick(value))),
      space,
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

  // Symbols are drawn over the series.
  const inSeries = (panel) => panel.curves.filter(({ draw }) => !SYMBOLS.includes(draw));

  // The points of a curve: squares or circles.
  function points(plot, index, from, to, { marker }) {
    const path = new Path2D(), r = (POINT() / 2) * window.devicePixelRatio, [abscissae, values] = [plot.data[0], plot.data[index]];
    for (let k = from; k <= to; k++) {
      if (values[k] == null) continue;
      const [x, y] = [plot.valToPos(abscissae[k], "x", true), plot.valToPos(values[k], "y", true)];
      path.moveTo(x + r, y);
      PATHS[marker === "s" ? "squares" : "dots"](path, x, y, r);
    }
    return { stroke: null, fill: path, clip: null, flags: 3 };
  }

  // A line that ends on both sides of a gap; uPlot would join both sides where the gap is narrower than a pixel.
  function line(plot, index, from, to) {
    const path = new Path2D(), [abscissae, values] = [plot.data[0], plot.data[index]];
    let next = "moveTo";
    for (let k = from; k <= to; k++) {
      if (values[k] === undefined) continue; // abscissa of another curve
      if (values[k] !== null) path[next](plot.valToPos(abscissae[k], "x", true), plot.valToPos(values[k], "y", true));
      next = values[k] === null ? "moveTo" : "lineTo";
    }
    return { stroke: path, fill: null, clip: null, flags: 1 };
  }

  function series(panel) {
    const shown = [], bands = [];
    for (const curve of inSeries(panel)) {
      const main = shown.length + 1;
      shown.push({
        label: curve.label, stroke: () => shade(curve.color) + (curve.draw === "pale" ? (isDark() ? "b0" : "80") : ""), spanGaps: false,
        ...(curve.draw === "line" ? { dash: curve.dash.map((length) => 1.5 * length), width: 1.5 } : { width: 1 }),
        ...(curve.draw === "points" ? { paths: () => null } : curve.low ? {} : { paths: line }),
        points: { show: curve.draw === "points", paths: (plot, index, from, to) => points(plot, index, from, to, curve), fill: () => shade(curve.color) },
      });
      if (!curve.low) continue;
      for (const edge of ["low", "high"]) {
        shown.push({ label: `${curve.label} ${edge}`, stroke: "transparent", points: { show: false } });
      }
      // The band of points is that of the curve through them.
      if (curve.draw !== "points") bands.push({ series: [main + 2, main + 1], fill: () => `${shade(curve.color)}33` });
    }
    return { shown, bands };
  }

  // All panels of a chart have the axis of the last.
  function extent(chart) {
    const ends = chart.panels.flatMap((panel) => inSeries(panel)).flatMap(({ x }) => (x.length ? [x[0], x[x.length - 1]] : []));
    return ends.length ? [Math.min(...ends), Math.max(...ends)] : null;
  }

  function table(panel, x) {
    const tables = inSeries(panel).map((curve) => {
      const rows = [curve.x, curve.y];
      return curve.low ? [...rows, curve.low, curve.high] : rows;
    });
    if (panel.image) return [panel.image.x];
    if (x.range && !tables.some(([own]) => own[0] === x.range[0] && own[own.length - 1] === x.range[1])) tables.push([x.range]);
    // A gap includes the abscissae of other curves inside it (null mode 2): pieces of a line through it would be drawn.
    return tables.length === 1 ? tables[0] : uPlot.join(tables, tables.map((columns) => columns.map(() => 2)));
  }

  // The curves of all panels by name: their values under the cursor are in one row of the readout.
  function curveRows(chart) {
    const row = (curve) => ({ color: curve.color, marker: curve.marker, places: [], draws: new Set(), dash: [] });
    const rows = new Map(chart.names.map((name) => [name, chart.panels.flatMap(({ curves }) => curves).find(({ label }) => label === name)])
      .filter(([, curve]) => curve).map(([name, curve]) => [name, row(curve)]));
    chart.panels.forEach((panel, k) => {
      let series = 1;
      for (const curve of panel.curves) {
        if (!rows.has(curve.label)) rows.set(curve.label, row(curve));
        rows.get(curve.label).draws.add(curve.draw);
        if (SYMBOLS.includes(curve.draw)) continue;
        if (curve.draw === "line") rows.get(curve.label).dash = curve.dash;
        rows.get(curve.label).places.push({ k, series, bounded: Boolean(curve.low), shown: !["through", "pale"].includes(curve.draw) });
        series += curve.low ? 3 : 1;
      }
    });
    return rows;
  }

  // Abscissae of other curves (undefined) lie between the points of this curve: its nearest point is shown. A gap (null)
  // has no value.
  const MAX_DISTANCE = 60; // points
  function nearest(values, i) {
    for (let distance = 0; distance < MAX_DISTANCE; distance++) {
      const found = [i - distance, i + distance].find((k) => values[k] !== undefined);
      if (found !== undefined) return values[found] === null ? null : found;
    }
    return null;
  }

  function element(parent, tag, text = "", style = "") {
    const made = document.createElement(tag);
    made.textContent = text;
    made.className = style;
    return parent.appendChild(made);
  }

  // A piece of a curve as it is drawn: line with its dashes, points, or symbols.
  function swatch(holder, color, draws, dash, marker) {
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    svg.setAttribute("viewBox", "0 0 30 10");
    svg.setAttribute("class", "swatch");
    const lines = draws.has("line") || draws.has("through") || draws.has("path");
    const symbol = draws.has("points") && marker === "s" ? '<rect x="12.4" y="2.4" width="5.2" height="5.2"/>' : draws.has("points") || draws.has("dots") ? '<circle cx="15" cy="5" r="2.6"/>'
      : draws.has("crosses") && !lines ? '<path fill="none" d="M12 2l6 6m0-6l-6 6"/>'
        : draws.has("circles") && !lines ? '<circle fill="none" cx="15" cy="5" r="3.4"/>' : "";
    svg.innerHTML = (lines ? `<path fill="none" d="M0 5H30" stroke-dasharray="${dash.map((length) => 1.5 * length).join(" ")}"/>` : "") + symbol;
    svg.setAttribute("stroke-width", draws.has("line") ? 1.8 : 1.2);
    holder.appendChild(svg);
    paints.push(() => { svg.style.stroke = svg.style.fill = shade(color); });
  }

  // One table below the chart: a name for each curve, which hides it, and its value in each panel under the cursor. It
  // covers the caption while it shows values, so that the page does not move.
  function readout(holder, chart, drawn) {
    // A panel that is named as its only curve needs no legend.
    const named = chart.panels.every(({ curves, title, label }) => new Set(curves.map((curve) => curve.label)).size < 2 && (title || label).startsWith(curves[0]?.label ?? ""));
    const frame = element(holder, "div", "", named ? "legend named" : "legend"), table = element(frame, "table", "", "readout"), head = element(table, "tr");
    const abscissa = element(head, "th");
    const update = [(x) => { abscissa.textContent = `${chart.x.name}: ${x == null ? "–" : `${Number(x.toPrecision(6))} ${chart.x.unit}`}`; }];
    for (const panel of chart.panels) element(head, "td", panel.label);
    for (const [label, { color, places, draws, dash, marker }] of curveRows(chart)) {
      const row = element(table, "tr"), name = element(row, "th", "", "name");
      swatch(name, color, draws, dash, marker);
      name.append(label);
      name.title = "Hide or show this curve";
      name.addEventListener("click", () => {
        const shown = row.classList.toggle("hidden");
        for (const { k, series, bounded } of places) {
          for (let n = series; n < series + (bounded ? 3 : 1); n++) drawn[k].setSeries(n, { show: !shown });
        }
        for (const curve of chart.panels.flatMap((panel) => panel.curves)) if (curve.label === label) curve.hidden = shown;
        for (const plot of drawn) plot.redraw(false, false);
      });
      const cells = chart.panels.map(() => element(row, "td", "–"));
      for (const { k, series, bounded } of places.filter((place) => place.shown)) {
        update.push((x, i) => {
          const at = i == null ? null : nearest(drawn[k].data[series], i), value = at == null ? null : drawn[k].data[series][at];
          const high = value == null || !bounded ? null : drawn[k].data[series + 2][at];
          cells[k].textContent = value == null ? "–" : `${digits(value)}${high == null ? "" : ` ± ${digits(high - value)}`}`;
        });
      }
    }
    table.classList.add("idle");
    for (const show of update) show(null, null);
    return (plot) => {
      const i = plot.cursor.idx;
      frame.style.minHeight = i == null ? "" : `${frame.offsetHeight}px`;
      table.classList.toggle("idle", i == null);
      for (const show of update) show(i == null ? null : plot.data[0][i], i);
    };
  }

  function save(name, address) {
    const link = document.createElement("a");
    link.download = name;
    link.href = address;
    link.click();
  }

  // The curves as a table: columns of abscissa, value and limits for each curve, as the abscissae differ.
  function csv(chart) {
    const columns = chart.panels.flatMap((panel) => panel.curves.flatMap((curve) => [
      [chart.x.label, ...curve.x],
      ...["y", "low", "high"].filter((key) => curve[key]).map((key) => [`${panel.label}: ${curve.label}${key === "y" ? "" : ` ${key}`}`, ...curve[key]]),
    ]));
    const rows = Math.max(...columns.map((column) => column.length));
    // An apostrophe keeps spreadsheets from computing a name as a formula.
    const quoted = (text) => `"${text.replace(/^['\s]*[=+\-@]./s, "'$&").replaceAll('"', '""')}"`;
    const cell = (value) => (value == null ? "" : typeof value === "number" ? value : quoted(value));
    return Array.from({ length: rows }, (_, i) => columns.map((column) => cell(column[i])).join(",")).join("\n");
  }

  function png(drawn, title) {
    const sources = drawn.map((plot) => plot.ctx.canvas), canvas = document.createElement("canvas");
    canvas.width = Math.max(...sources.map((source) => source.width));
    const head = 24 * window.devicePixelRatio;
    canvas.height = sources.reduce((sum, source) => sum + source.height, head);
    const context = canvas.getContext("2d");
    context.fillStyle = getComputedStyle(document.body).backgroundColor;
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.fillStyle = theme("text");
    context.font = `600 ${head / 1.7}px system-ui, sans-serif`;
    context.fillText(title, head / 2, 0.75 * head);
    let top = head;
    for (const source of sources) {
      context.drawImage(source, 0, top);
      top += source.height;
    }
    return canvas.toDataURL("image/png");
  }

  function tools(holder, chart, drawn) {
    const head = holder.previousElementSibling, title = head.textContent, bar = element(head, "span", "", "tools"), name = holder.dataset.source;
    if (chart.panels.some((panel) => panel.curves.length)) {
      element(bar, "button", "CSV").addEventListener("click", () => {
        save(`${name}.csv`, `data:text/csv;charset=utf-8,${encodeURIComponent(csv(chart))}`);
      });
    }
    element(bar, "button", "PNG").addEventListener("click", () => save(`${name}.png`, png(drawn, title)));
    // The same for all charts.
    if (holder === document.querySelector(".chart")) element(bar, "span", "Drag sideways: zoom. Double-click or double-tap: reset.");
  }

  // uPlot zooms with the mouse; a finger that moves sideways selects a range in the same way.
  function zoomByTouch(plot) {
    let start = null, lastTap = 0;
    const position = (event) => event.clientX - plot.over.getBoundingClientRect().left;
    plot.over.addEventListener("pointerdown", (event) => {
      if (event.pointerType !== "touch") return;
      start = position(event);
      if (event.timeStamp - lastTap < 300) plot.setData(plot.data);
      lastTap = event.timeStamp;
    });
    plot.over.addEventListener("pointermove", (event) => {
      if (start == null || event.pointerType !== "touch") return;
      const left = Math.min(start, position(event)), width = Math.abs(position(event) - start);
      plot.setSelect({ left, width, top: 0, height: plot.over.clientHeight }, false);
    });
    plot.over.addEventListener("pointerup", (event) => {
      if (start == null || event.pointerType !== "touch") return;
      const ends = [start, position(event)].sort((a, b) => a - b), [low, high] = ends.map((x) => plot.posToVal(x, "x"));
      plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
      if (ends[1] - ends[0] > 10) for (const other of plots.filter(({ holder }) => holder.contains(plot.root))) other.plot.setScale("x", { min: low, max: high });
      start = null;
    });
    plot.over.addEventListener("pointercancel", () => { start = null; });
  }

  // Height of a panel: at least that of its title.
  function height(panel, last) {
    measure.font = FONT;
    const title = measure.measureText(panel.label).width + 10;
    return Math.max(printing ? printHeight(panel) : panel.height, title) + (last ? 52 : 6) + LABEL_ROW * Math.min(panel.marks.length, LABEL_ROWS);
  }

  function draw(holder, chart, number) {
    const drawn = [];
    let show = () => {};
    for (const curve of chart.panels.flatMap(({ curves }) => curves)) {
      for (const key of ["x", "y", "low", "high"].filter((name) => curve[name])) curve[key] = abscissa(curve[key]);
    }
    chart.x.range = chart.x.range || extent(chart);
    chart.panels.forEach((panel, k) => {
      const last = k === chart.panels.length - 1, { shown, bands } = series(panel);
      const canvas = panel.image ? picture(panel.image) : null;
      const plot = new uPlot({
        width: holder.clientWidth || PRINT_WIDTH, height: height(panel, last), padding: [(u) => 8 + LABEL_ROW * Math.max(0, ...labelsOf(u, panel, 0, Infinity).map(({ row }) => row + 1)), 16, 0, 0],
        scales: {
          x: { time: false, distr: chart.x.log ? 3 : 1, range: (u, low, high) => [low, high] },
          y: { distr: panel.log ? 3 : 1, range: range(panel.log, panel.range) },
        },
        axes: [
          axis(last ? chart.x.label : "", chart.x.log, last ? 34 : 6, chart.x.log ? 34 : 70),
          // A quarter of a low panel leaves space for three labels.
          axis(panel.label, panel.log, 58, (u, number, low, high, length) => Math.min(26, length / 4), panel.ticks),
        ],
        series: [{ label: chart.x.name }, ...shown],
        bands,
        cursor: { sync: { key: `chart${number}`, setSeries: false, scales: ["x", null] }, drag: { x: true, y: false } },
        legend: { show: false },
        hooks: { setCursor: [(u) => show(u)], draw: [(u) => annotate(u, panel)], ...(canvas ? { drawClear: [(u) => drawImage(u, panel.image, canvas)] } : {}) },
      }, table(panel, chart.x), holder);
      zoomByTouch(plot);
      drawn.push(plot);
      plots.push({ plot, holder, height: () => height(panel, last) });
    });
    tools(holder, chart, drawn);
    if (chart.panels.some((panel) => panel.curves.length)) show = readout(holder, chart, drawn);
    holder.dataset.drawn = chart.panels.length;
    if (chart.x.view) for (const plot of drawn) plot.setScale("x", { min: chart.x.view[0], max: chart.x.view[1] });
  }

  // Drawings have the colors of the charts.
  for (const key of ["stroke", "fill"]) {
    document.querySelectorAll(`svg [${key}^="#"]`).forEach((each) => paints.push(() => { each.style[key] = shade(each.getAttribute(key)); }));
  }
  const repaint = () => paints.forEach((paint) => paint());

  function redraw() {
    repaint();
    for (const { plot } of plots) plot.redraw(false, true);
  }

  function resize() {
    for (const { plot, holder, height } of plots) {
      const width = printing ? PRINT_WIDTH : holder.clientWidth;
      if (width && (width !== plot.width || height() !== plot.height)) plot.setSize({ width, height: height() });
    }
    for (const each of document.querySelectorAll(".wide")) {
      each.classList.remove("overflows");
      each.classList.toggle("overflows", each.scrollWidth > each.clientWidth + 1);
    }
  }

  document.querySelectorAll(".chart").forEach((holder, number) => {
    draw(holder, JSON.parse(document.getElementById(holder.dataset.source).textContent), number);
  });
  resize();
  repaint();
  window.addEventListener("resize", resize);
  scheme.addEventListener("change", redraw);
  document.querySelectorAll("details").forEach((details) => details.addEventListener("toggle", resize));
  // Paper shows the settings and scene files, which repeat the test, and spectrograms that are open on the screen.
  const showDetails = (open) => document.querySelectorAll("details:not(.spectrograms)").forEach((details) => { details.open = open; });
  window.addEventListener("beforeprint", () => { printing = true; showDetails(true); resize(); redraw(); });
  window.addEventListener("afterprint", () => { printing = false; showDetails(false); resize(); redraw(); });
})();
