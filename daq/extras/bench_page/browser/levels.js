// A bar for each channel: its peak relative to full scale, the held peak, and a latched overload with its cause.
"use strict";

// A phone has space for two lines, without causes.
const IS_NARROW = matchMedia("(max-width: 900px)");
const HOLD_MS = 3000;
const FLOOR_DB = -120; // the noise of a sensor is visible

const levels = {
  start(channels) {
    this.rows = channels.map((channel) => {
      const name = make($("levels"), "span", channel.name), level = make($("levels"), "div"), value = make($("levels"), "span", "–");
      for (const [part, kind] of [[name, "name"], [level, "level"], [value, "value"]]) {
        part.className = kind;
        part.style.setProperty("--channel", channel.color);
      }
      const limit = channel.limit == null ? "no limit" : `full scale ${withUnit(channel.limit, channel.unit)}`;
      name.title = level.title = value.title = `${channel.name}: peak of the last 0.25 s; white: held peak; ${limit}; from ${FLOOR_DB} to 0 dB`;
      if (channel.limit != null) make(value, "small", ` of ${withUnit(channel.limit, channel.unit)}`);
      return { channel, name, bar: make(level, "i"), hold: make(level, "b"), value, held: 0, since: 0, over: false };
    });
    make($("levels"), "span");
    const scale = make($("levels"), "span");
    scale.className = "scale";
    for (const decibels of [FLOOR_DB, FLOOR_DB / 2, 0]) make(scale, "span", `${decibels}`.replace("-", "−"));
  },

  update({ state }) {
    const now = performance.now(), causes = new Map();
    this.rows.forEach((row, k) => {
      const { channel } = row, level = state.levels[k], overload = state.overloads[k];
      if (level >= row.held || now - row.since > HOLD_MS) [row.held, row.since] = [level, now];
      row.bar.style.width = `${part(level, channel.limit)}%`;
      row.hold.style.left = `calc(${part(row.held, channel.limit)}% - 2px)`;
      const clips = state.clipping.includes(k);
      row.value.firstChild.data = `${clips ? "≥ " : ""}${withUnit(level, channel.unit, 3, reading)}`;
      row.value.classList.toggle("bound", clips);
      row.over = Boolean(overload);
      row.name.classList.toggle("over", row.over);
      if (!overload) return;
      const [first, last, largest] = overload, times = new Set([first, last].map((time) => digits(time, 4)));
      const text = `${cause(channel, largest)} (${[...times].join(" to ")}\u00a0s)`;
      causes.set(text, [...(causes.get(text) ?? []), channel.name]);
    });
    // Channels with the same cause and times are listed together.
    const texts = [...causes].map(([text, names]) => `${names.join(", ")}: ${text}`);
    $("alarm").hidden = !texts.length;
    const latest = Math.max(...Object.values(state.overloads).map(([, last]) => last));
    const names = [...causes.values()].flat(), who = names.length > 2 ? `${names.length} channels` : names.join(", ");
    setText("causes", IS_NARROW.matches ? `Overload: ${who}, latest at ${digits(latest, 4)}\u00a0s. Lower the level.` : `Overload: ${texts.join("; ")}. Lower the level or extend the range.`);
  },
};

// Whether a channel was overloaded since the last Clear.
function isOver(name) {
  return levels.rows.some((row) => row.over && row.channel.name === name);
}

// A clipped reading equals the limit; the excess of the signal is unknown.
function cause({ unit, limit }, reading) {
  if (limit == null) return `${withUnit(reading, unit)}, limit of its sensor`;
  return reading > 1.01 * limit ? `${withUnit(reading, unit)}, limit ${withUnit(limit, unit)}` : `clipped at ${withUnit(limit, unit)}`;
}

function part(level, limit) {
  if (limit == null || !(level > 0)) return 0;
  return Math.min(100, Math.max(0, 100 * (1 - (20 * Math.log10(level / limit)) / FLOOR_DB)));
}
