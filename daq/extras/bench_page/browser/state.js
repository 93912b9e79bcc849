// The bar at the top: state, progress, force, delay, recording; outputs, NI clients and impacts below the controls.
"use strict";

const bar = {
  start({ scene, address }) {
    document.title = `daq bench: ${scene}`;
    $("scene").textContent = scene;
    $("address").textContent = address;
    this.pulse = new Chart($("pulse"), { name: "time / ms", log: false });
  },

  update({ state, arrays, pulse_step: step }) {
    setText("pill", state.state);
    $("bar").dataset.state = state.state;
    setText("message", state.message);
    const { progress, remaining } = state;
    $("progress").hidden = progress == null;
    $("progress").querySelector("i").style.width = `${100 * (progress ?? 0)}%`;
    $("progress").lastChild.textContent = progress == null ? "" : `${Math.floor(100 * progress)} %${remaining == null ? "" : `, ${Math.ceil(remaining)} s left`}`;
    const client = state.is_driven_by_clients && response.curves?.level === null ? clientLevel(response.curves) : null;
    $("readout").classList.toggle("idle", !state.running && !client);
    setText("tone", `${reading(client?.kind === "rms" ? null : state.tone, 4)} Hz`);
    setText("measured", `${reading(client ? client.level : state.running ? state.force : null, 3)} N`);
    setText("force", state.running ? `force ${state.level_kind}` : client ? `force ${client.kind}` : "measured force");
    setText("target", state.running ? targetText(state) : "");
    setText("lag", state.lag < 0.04 ? "" : `${Math.round(1000 * state.lag)} ms late`);
    $("lag").classList.toggle("bad", state.lag >= 0.25);
    this.showRecording(state);
    setText("outputs", state.outputs.join("\n"));
    setText("clients", state.clients.join("\n") || "no task of an NI client");
    setText("problem", state.problem);
    $("pulse").hidden = !arrays.pulse;
    setText("no-hit", arrays.pulse ? "" : state.running ? "waiting for the impact" : "none: press Start, or add one impact");
    if (arrays.pulse) {
      const force = arrays.pulse[0];
      this.pulse.show([0, 1000 * step * force.length], [
        { name: "force / N", range: [-0.1 * roundUp(Math.max(...force)), roundUp(Math.max(...force))], curves: [{ x: force.map((_, k) => 1000 * step * k), y: force, color: "#ffffff" }] }]);
    }
    this.showHits(state.hits);
    setText("response-note", response.note(state));
  },

  showRecording({ recording, recorded, enabled, running }) {
    const last = recorded.length && !recording ? recorded[recorded.length - 1] : "";
    setText("after", recording ? `recording to ${recording}` : last && !running ? `recorded ${last}; next: analysis frf ${last}`
      : enabled ? "records as soon as a test or a client's task runs" : "not recording");
    $("report").hidden = !last || running;
    $("report").href = `report/${recorded.length}`;
  },

  showHits(hits) {
    const shown = JSON.stringify(hits);
    if (shown === this.shownHits) return;
    this.shownHits = shown;
    $("hit-list").replaceChildren();
    for (const hit of hits) {
      const [number, peak, , accepted, complete, overloaded] = hit;
      const isClipped = overloaded.some((row) => channels[row].at === "hammer");
      const verdict = verdictOf(hit);
      const row = make($("hit-list"), "tr"), box = make(make(row, "td"), "input");
      Object.assign(box, { type: "checkbox", checked: accepted, disabled: !complete, title: "Use this impact for the response" });
      box.addEventListener("change", () => send("accept", [number, box.checked]));
      make(row, "td", `${number}`);
      make(row, "td", `${isClipped ? "≥ " : ""}${reading(peak, 3)} N`).className = isClipped ? "bound" : "";
      make(row, "td", isJudged(hit) ? (accepted ? "✓" : "✗") : "").className = accepted ? "" : "excluded";
      make(row, "td", verdict || (complete ? "good" : "measuring")).className = verdict ? "bound" : "";
    }
  },
};

// The faults of an impact, with the channels that clipped.
function verdictOf([, , faults, , , overloaded]) {
  const clipped = overloaded.length > 2 ? `${overloaded.length} channels` : overloaded.map((row) => channels[row].name).join(", ");
  return faults.map((fault) => (fault === "clipped" ? `${clipped} clipped` : fault)).join(", ");
}

// Whether an impact is accepted or rejected: a weak pulse may still rise, other faults are final.
function isJudged([, , faults, , complete]) {
  return complete || faults.some((fault) => fault !== "too weak");
}

// The level of the test, and the deviation of the measured force as soon as it is known.
function targetText({ target, force }) {
  const percent = (100 * (force / target - 1)).toFixed(1), sign = Number(percent) ? (percent < 0 ? "−" : "+") : "";
  return `target ${reading(target, 3)} N${force == null ? "" : ` (${sign}${percent.replace("-", "")} %)`}`;
}
