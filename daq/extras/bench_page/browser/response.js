// The frequency response: magnitude, phase, coherence; cursors, peaks, and the curves of the last test and of theory.
"use strict";

const response = {
  curves: null, // {test, frequency, rows: [{name, color, magnitude, phase, coherence, relation, determined}]}
  previous: null,
  theory: null, // {frequency, rows: [[...]]}
  cursors: [], // frequencies that the operator selected

  start(channels, isLinear) {
    this.channels = channels.filter((channel) => channel.responds);
    this.isLinear = isLinear;
    if (!isLinear) $("theory").nextSibling.data = " linear theory, no dampers · · ·";
    setText("damping-kind", isLinear ? "half-power damping, 95 %" : "approximate: nonlinear");
    this.chart = new Chart($("frf"), { name: "frequency / Hz", log: false });
    this.describe();
    fillLegend($("legend"), this.channels);
    make($("legend"), "small").id = "thin";
    $("frf").addEventListener("click", (event) => {
      const frequency = this.nearest(this.chart.value(event.offsetX));
      if (IS_TOUCH) this.cursors = [...this.cursors, frequency].slice(-2);
      else (this.cursors = [...this.chart.cursors])[event.shiftKey ? 1 : 0] = frequency;
      this.draw();
    });
    $("frf").addEventListener("dblclick", () => { this.cursors = []; this.draw(); });
    $("last").addEventListener("change", () => this.draw());
    $("theory").addEventListener("change", () => ($("theory").checked ? send("theory") : this.draw()));
  },

  // Process a message. When a test begins, the curves of the previous test become the curves of the last test.
  update({ response: head, arrays, state }) {
    const ends = this.isGrowing && !state.running;
    this.isGrowing = state.running;
    if (!head) {
      if (ends) this.draw();
      return;
    }
    if (this.curves && this.curves.test !== head.test) [this.previous, this.curves, this.cursors] = [this.curves, null, []];
    this.head = head;
    if (arrays.frequency) {
      const { frequency, magnitude, phase, coherence, coherence_limit: [limit] } = arrays;
      const rows = this.channels.map((channel, k) => {
        const angle = wrapped(phase[k]), smooth = determined(angle, coherence[k], limit);
        const row = { ...channel, magnitude: magnitude[k], phase: angle, coherence: coherence[k], relation: arrays.relation[k], smooth };
        const unresolved = head.peaks.filter(([, , damping, , name]) => damping == null && name === channel.name);
        row.certain = outsidePeaks(row, unresolved.map(([f]) => frequency[0].indexOf(Math.fround(f))));
        // A single average has a smooth phase, but an unknown scatter.
        return { ...row, determined: row.certain.map((each, line) => each && isFinite(limit[line])) };
      });
      this.curves = { test: head.test, level: head.level, limit, force: arrays.force[0], frequency: frequency[0], rows };
    }
    if ($("theory").checked && this.band?.join() !== head.band?.join()) send("theory");
    this.band = head.band;
    this.draw();
  },

  setTheory({ theory, arrays }) {
    this.theory = theory ? null : { frequency: arrays.theory_frequency[0], rows: arrays.theory_magnitude };
    this.problem = theory;
    this.draw();
  },

  // A text on the content of the chart, or on the reason why it is empty.
  note(state) {
    $("response").classList.toggle("empty", !state.running && !this.curves && !this.previous && !(this.theory && $("theory").checked));
    $("hint").hidden = state.running || this.curves || (this.theory && $("theory").checked);
    const averages = this.head?.averages;
    this.details = state.details;
    const [last] = state.hits, empty = last ? (last[4] ? "no accepted impact" : "after this impact") : state.running ? "after settling" : "start a test";
    setText("hint", last && !last[3] ? `No accepted impact: ${verdictOf(last) || "rejected by the operator"}. ${last[2].includes("clipped") ? "Lower the level." : "Add another impact."}` : HINT);
    const impacts = last ? last[0] - !isJudged(last) : 0;
    const count = impacts > 0 ? `${averages} of ${impacts} impact${impacts > 1 ? "s" : ""} averaged` : `H1, ${averages} average${averages > 1 ? "s" : ""}`;
    return (averages ? count + (averages > 1 ? "" : ": no γ²") : state.frf_reason || empty) + (this.problem ? `; ${this.problem}` : "");
  },

  // The band of the test, or of a pulse: at most DECADES up to the highest excited frequency.
  range() {
    if (this.band) return this.band;
    const shown = this.curves ?? this.previous;
    if (!shown) return [1, 100];
    const last = Math.max(...shown.rows.map((row) => row.magnitude.findLastIndex((value) => isFinite(value)))), high = shown.frequency[Math.max(last, 1)];
    const low = shown.frequency.find((value, k) => value > 0 && shown.rows.some((row) => isFinite(row.magnitude[k])));
    return [Math.max(low ?? 0, high / 10 ** DECADES), high];
  },

  draw() {
    const micro = (values) => Float32Array.from(values, (value) => 1e6 * value);
    const { curves, previous, theory } = this, magnitude = [], phase = [];
    const coherence = curves ? [{ x: curves.frequency, y: curves.limit, color: LAST, dash: [5, 4], width: 1 }] : [];
    $("last").parentNode.hidden = !previous;
    const showsLast = previous && $("last").checked;
    if (showsLast) for (const row of previous.rows) magnitude.push({ x: previous.frequency, y: micro(row.magnitude), color: LAST, width: 1, opacity: 0.8 });
    const isSingle = !curves?.limit.some(isFinite), isClipped = curves?.rows.some((row) => row.relation.some(Boolean));
    setText("thin", [curves ? [curves.level == null ? `NI clients, ${digits(clientLevel(curves).level, 3)} N ${clientLevel(curves).kind}` : `${digits(curves.level, 3)} N`, `Δf ${digits(curves.frequency[1] - curves.frequency[0], 2)} Hz`, this.details].filter(Boolean).join(", ") : "", isClipped ? "dashed: clipped; the arrow points toward the true value" : "", curves ? `thin: ${scatterText(curves)}` : "", showsLast ? `gray: last test${previous.level == null ? "" : `, ${digits(previous.level, 3)} N`}` : ""].filter(Boolean).join("; "));
    if (theory && $("theory").checked) {
      theory.rows.forEach((row, k) => magnitude.push({ x: theory.frequency, y: micro(row), color: `color-mix(in srgb, ${this.channels[k].color}, white 15%)`, dash: [2, 4], width: 1.2 }));
    }
    for (const [number, row] of (curves?.rows ?? []).entries()) {
      const style = { x: curves.frequency, color: row.color, dots: true, mark: number };
      const [certain, smooth] = [row.certain, row.smooth].map((lines) => lines.map((each, k) => each && !row.relation[k]));
      const angular = (row.angular = longRuns(smooth, RUN, row.coherence, this.isGrowing && !isSingle)), only = (y, isShown) => y.map((value, k) => (isShown(k) ? value : NaN));
      magnitude.push({ ...style, y: micro(row.magnitude), width: 0.9, opacity: 0.6, noisy: true });
      magnitude.push({ ...style, y: only(micro(row.magnitude), (k) => row.relation[k]), width: 1.6, dash: [5, 4] });
      magnitude.push({ ...style, y: only(micro(row.magnitude), (k) => certain[k]), width: isSingle ? 0.9 : 1.8 });
      // The line is interrupted where the phase wraps; a few lines between two such positions are no curve.
      const drawn = longRuns(angular.map((each, k) => each && !(Math.abs(row.phase[k] - row.phase[k - 1]) > 180)), PIECE);
      phase.push({ ...style, y: only(row.phase, (k) => drawn[k]), width: isSingle ? 0.9 : 1.6 });
      coherence.push({ ...style, y: row.coherence, width: 0.9, opacity: 0.6 }, { ...style, y: only(row.coherence, (k) => certain[k]) }, { ...style, y: only(row.coherence, (k) => row.relation[k]), dash: [5, 4] });
      // Arrows at the highest clipped point show on which sides of it the true value may be.
      const highest = row.magnitude.reduce((best, value, k) => (row.relation[k] && value > (row.magnitude[best] || 0) ? k : best), -1);
      if (highest >= 0) magnitude.push({ x: [curves.frequency[highest]], y: Float32Array.of(1e6 * row.magnitude[highest]), color: AMBER, width: 2, arrows: [[1], [-1], [1, -1]][row.relation[highest] - 1] });
    }
    const fixed = (values) => values.map((value) => [value, true]), range = this.range();
    // Noise does not determine the axis of the magnitude; arrows need space.
    const [low, high] = limits({ log: true, curves: magnitude.filter((curve) => !curve.noisy) });
    this.chart.cursors = this.cursors.length || !curves ? this.cursors : largestTone(curves);
    // The axis is logarithmic unless the band is narrow, as in figures and report.
    this.chart.x.log = range[1] >= 2 * range[0] && range[0] > 0;
    this.chart.show(range, [
      { name: "|compliance| / (µm/N)", log: true, share: 4, curves: magnitude, range: [low, isClipped ? 2 * high : high] },
      { name: "phase / °", range: [-345, 45], ticks: fixed([-270, -180, -90, 0]), share: 1.3, curves: phase },
      // A single average has no coherence.
      ...(curves && isSingle ? [] : [{ name: "γ²", range: [0, 1.2], ticks: fixed([0, 0.5, 1]), share: 0.8, curves: coherence }]),
      ...(curves ? this.forcePanel(curves) : []),
    ]);
    this.describe();
  },

  // The force at each line, and its level (dashed); empty for impacts, whose force is in the panel of the impact, and
  // for a few tones, whose force is in the text above the chart.
  forcePanel({ frequency, force, level }) {
    if (force.filter(isFinite).length < (level == null ? FEW : 1)) return [];
    const required = level == null ? [] : [{ x: [frequency[0], frequency[frequency.length - 1]], y: Float32Array.of(level, level), color: LAST, dash: [5, 4], width: 1 }];
    const largest = roundUp(Math.max(level ?? 0, ...force.filter(isFinite)));
    return [{ name: level == null ? "rms / N" : "force / N", range: [0, largest], ticks: [[0, true], [largest / 2, false], [largest, true]], share: 0.8, curves: [...required, { x: frequency, y: force, color: "#ffffff" }] }];
  },

  nearest(frequency) {
    if (!this.curves) return frequency;
    return this.curves.frequency.reduce((best, f, k) => (this.curves.rows.some((row) => isFinite(row.magnitude[k])) && Math.abs(f - frequency) < Math.abs(best - frequency) ? f : best), Infinity);
  },

  // Return whether a peak is uncertain: the curve is thin there.
  isUncertain([frequency, , , , name]) {
    const row = this.curves?.rows.find((each) => each.name === name), k = this.curves?.frequency.indexOf(Math.fround(frequency));
    return row !== undefined && !row.determined[k];
  },

  // The value and the phase of a curve at a line; uncertain values have the sign ~, and no phase if none is drawn.
  cell({ magnitude, phase, relation, determined: certain, angular }, k) {
    const sign = RELATIONS[relation[k]] || (certain[k] || !isFinite(magnitude[k]) ? "" : "~");
    return `${sign}${reading(1e6 * magnitude[k], 3)}\n${angular[k] ? `${reading(phase[k], 3)}°` : "–"}`;
  },

  // The values at the cursors, and the peak list.
  describe() {
    const { curves } = this, cursors = this.chart.cursors.map((f) => [f, curves?.frequency.indexOf(f) ?? -1]);
    const columns = cursors.flatMap(([f, k], number) => (k < 0 ? [] : [["AB"[number], digits(f, 5), ...curves.rows.map((row) => this.cell(row, k))]]));
    setText("cursor-hint", columns.length ? "" : CURSOR_HINT);
    if (columns.length > 1) {
      const [[f, i], [g, k]] = cursors;
      columns.push(["B − A", digits(g - f, 4), ...curves.rows.map((row) => `${row.determined[i] && row.determined[k] ? "" : "~\u2009"}${reading(20 * Math.log10(row.magnitude[k] / row.magnitude[i]), 3)}`)]);
    }
    const names = columns.length ? ["", "f / Hz", ...this.channels.map((channel) => channel.name)] : [];
    fillTable($("cursors"), names.map((name, k) => [name, ...columns.map((column) => column[k])]));
    const peaks = this.head?.peaks ?? [];
    $("peak-hint").hidden = peaks.length > 0;
    const uncertain = peaks.map((peak) => this.isUncertain(peak));
    fillTable($("peaks"), [["peak", "f / Hz", "µm/N", "ζ / %"], ...peaks.map(([f, value, damping, expanded, name, relation], k) => [
      name, digits(f, 5), relation === "?" ? "clipped" : `${relation || (uncertain[k] ? "~" : damping == null ? "≥ " : "")}${reading(1e6 * value, 3)}`,
      damping == null || uncertain[k] ? "–" : this.isLinear ? withInterval(100 * damping, 100 * expanded) : `~${reading(100 * damping, 2)}`])]);
    peaks.forEach(([, , damping, , , relation], k) => {
      const row = $("peaks").rows[k + 1];
      row.classList.toggle("bound", relation !== "");
      row.classList.toggle("uncertain", uncertain[k]);
      row.title = uncertain[k] ? "Uncertain: the curve is thin here. Sweep slower, or average more." : "";
      if (damping == null && !uncertain[k]) row.lastChild.title = relation ? "No damping: the peak is clipped." : "Lower limit, no damping: the half-power width has fewer than 3 lines, one side of the peak is not measured, or its coherence is low.";
    });
  },
};

// A touch screen has no shift key. A browser without a pointing device, which draws pictures, is no touch screen.
const IS_TOUCH = matchMedia("(pointer: coarse)").matches;
const HINT = "Start a test: the response of the structure grows here.";
const CURSOR_HINT = IS_TOUCH ? "The last two taps are cursors A and B." : "Click: cursor A. Shift and click: cursor B. Double-click: none.";
// Signs of the relation of the true value to a clipped one.
const RELATIONS = ["", "≥", "≤", "? "];
// Color of the last test: its curves lie behind those of the present test.
const LAST = "#8994a0";
// A spectral line is noise if the phase steps exceed this angle, degrees, at a quarter of the lines around it.
const LARGEST_STEP = 17;
const AROUND = 40; // lines on either side
const DECADES = 2.5;
// The phase is shown in runs of at least RUN lines with this mean coherence: other runs are noise.
const COHERENT_PHASE = 0.9, RUN = 12;
const PIECE = 4; // lines of the shortest drawn piece of a phase between two wraps

// The force of the lines that NI clients excite: the largest rms, or the amplitude of the largest of a few tones.
function clientLevel({ force }) {
  const known = force.filter(isFinite), isTone = known.length < FEW;
  return { level: known.length ? Math.max(...known) * (isTone ? Math.SQRT2 : 1) : null, kind: isTone ? "amplitude" : "rms" };
}

// The frequency of the largest of a few tones of NI clients, at which cursor A has its values.
function largestTone({ level, frequency, force }) {
  const known = force.filter(isFinite);
  return level == null && known.length && known.length < FEW ? [frequency[force.indexOf(Math.max(...known))]] : [];
}

// The reason why a curve is thin.
function scatterText({ limit, force, rows }) {
  const hasFastPeak = rows?.some(({ certain, smooth }) => certain.some((each, k) => each !== smooth[k]));
  if (limit.some(isFinite)) return `γ² below dashed limit${hasFastPeak ? ` (${COHERENT_PHASE} at peaks without damping)` : ""}, or phase scatters`;
  return `one ${force.some(isFinite) ? "average" : "impact"}: scatter unknown`;
}

// Remove runs of few lines or with a low coherence, unless there are no other runs, as with a few tones. The first and
// the last run of a growing curve may be as short as a piece, because a sweep in either direction prolongs them.
function longRuns(values, fewest, coherence = null, isGrowing = false) {
  const isCoherent = ([start, stop]) => !(coherence?.slice(start, stop).reduce((sum, value) => sum + value, 0) < COHERENT_PHASE * (stop - start));
  const starts = values.map((value, k) => (value ? k : -1)).filter((k) => k >= 0 && !values[k - 1]);
  const end = (start) => (values.indexOf(false, start) + values.length + 1) % (values.length + 1);
  const runs = starts.map((start) => [start, end(start)]), isEnd = (run) => isGrowing && (run === runs[0] || run === runs.at(-1));
  const long = runs.filter((run) => run[1] - run[0] >= (isEnd(run) ? PIECE : fewest) && isCoherent(run));
  return long.length ? values.map((_, k) => long.some(([start, stop]) => k >= start && k < stop)) : values;
}

// Return whether the response at each line is determined: coherent, and with a phase that does not scatter.
function determined(phase, coherence, limit) {
  const steps = phase.map((value, k) => (k ? Math.abs(value - phase[k - 1]) : 0));
  const around = (values, k) => values.slice(Math.max(k - AROUND, 0), k + AROUND + 1);
  const smooth = Array.from(steps, (_, k) => {
    const near = around(steps, k);
    return near.filter((step) => Math.min(step, 360 - step) > LARGEST_STEP).length < near.length / 4;
  });
  // A few lines among noise have a smooth phase by chance.
  const inside = smooth.map((_, k) => around(smooth, k).every(Boolean));
  // A single average has no coherence; among averages, a line without coherence is uncertain.
  const isSingle = coherence.every(isNaN);
  return Array.from(coherence, (value, k) => (isSingle || value >= limit[k]) && around(inside, k).some(Boolean));
}

// Certain lines: smooth, and not at a peak without damping whose coherence is low, which the test passes too fast for a
// lower limit. Such a peak extends to half of its power.
function outsidePeaks({ smooth, magnitude, coherence }, peaks) {
  const certain = smooth.slice();
  for (const peak of peaks) {
    for (const step of [-1, 1]) {
      for (let k = peak; coherence[k] < COHERENT_PHASE && magnitude[k] >= Math.SQRT1_2 * magnitude[peak]; k += step) certain[k] = false;
    }
  }
  return certain;
}

// The phase from -330° to 30°, as in the report: a receptance out of phase stays at -180°, and in phase at 0°.
function wrapped(phase) {
  return phase.map((value) => (value > 30 ? value - 360 : value));
}
