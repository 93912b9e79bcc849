// The form of the test, buttons, switches and keys.
"use strict";

const LABELS = {
  kind: ["Test", "Kind of test"],
  level: ["Level / N", "Force in N: amplitude of a sine or sweep, rms of a random test, peak of an impact"],
  frequency: ["Frequency / Hz", "Frequency of the sine, Hz"],
  low: ["From / Hz", "Lower end of the band, Hz"],
  high: ["To / Hz", "Upper end of the band, Hz"],
  duration: ["Duration / s", "Duration of the measurement, s"],
  interval: ["Interval / s", "Time between impacts, s"],
  hits: ["Impacts", "Number of impacts"],
};
const SPANS = [0.2, 1, 5]; // s

const controls = {
  fields: {},
  running: false,

  start({ forms, has_hammer: hasHammer }) {
    this.forms = forms;
    for (const [name, [label, help]] of Object.entries(LABELS)) {
      const title = make($("form"), "label", label), field = make($("form"), name === "kind" ? "select" : "input");
      if (name === "kind") for (const form of Object.keys(forms)) make(field, "option", form);
      else Object.assign(field, { type: "number", step: "any" });
      field.dataset.testid = name;
      field.id = title.htmlFor = `field-${name}`;
      field.title = title.title = help;
      field.addEventListener("change", () => send(name, field.value));
      this.fields[name] = [title, field];
    }
    $("form").addEventListener("submit", (event) => event.preventDefault());
    $("stop").addEventListener("click", () => (this.records ? send("record", false) : this.request("stop")));
    for (const name of ["start", "hit"]) $(name).addEventListener("click", () => this.request(name));
    $("clear").addEventListener("click", () => send("clear"));
    $("record").addEventListener("change", () => send("record", $("record").checked));
    $("freeze").addEventListener("click", () => freeze());
    $("hit").hidden = $("hit-key").hidden = $("hit-panel").hidden = !($("readout").hidden = hasHammer);
    for (const span of SPANS) {
      const button = make($("spans"), "button", `${span} s`);
      button.title = `Show the last ${span} s`;
      button.addEventListener("click", () => send("span", span));
    }
    document.addEventListener("keydown", (event) => this.press(event));
  },

  // The start of a test can take seconds.
  request(name) {
    setText("message", name === "stop" ? "stopping" : "starting");
    send(name);
  },

  // Keys have no effect while a field is edited. A space must not also press the focused button.
  press(event) {
    if (event.target.matches("input:not([type=checkbox]), select") || event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
    const actions = { " ": () => this.request(this.running ? "stop" : "start"), f: freeze, h: () => this.request("hit") };
    const action = actions[event.key.toLowerCase()];
    if (!action || $("controls").inert) return;
    event.preventDefault();
    action();
  },

  update({ state, span }) {
    this.running = state.running;
    const shown = ["kind", ...(this.forms[state.settings.kind] ?? [])];
    for (const [name, [title, field]] of Object.entries(this.fields)) {
      title.hidden = field.hidden = !shown.includes(name);
      if (document.activeElement !== field) field.value = state.settings[name] ?? "";
    }
    $("start").disabled = $("hit").disabled = state.running || state.is_driven_by_clients;
    $("form").inert = !($("driven").hidden = !state.is_driven_by_clients);
    // NI clients end their tasks themselves; the operator can end the recording.
    this.records = !state.running && state.recording !== "";
    setText("stop", this.records ? "Stop recording" : "Stop");
    $("stop").disabled = !state.running && !this.records;
    $("stop").classList.toggle("live", state.running || this.records);
    $("record").checked = state.enabled;
    for (const [k, button] of [...$("spans").children].entries()) button.classList.toggle("on", SPANS[k] === span);
  },
};
