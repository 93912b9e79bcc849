// Moves the parts of the drawn rig through frames {identifier: [heights, scales]}; scales stretch springs.
"use strict";

const rig = {
  frames: {},

  start({ animation, slow }) {
    this.milliseconds = 1000 * animation;
    $("slow").textContent = `${slow} times slower`;
    requestAnimationFrame((now) => this.draw(now));
  },

  update({ svg, motion }) {
    if (svg) $("drawing").innerHTML = svg;
    if (motion) [this.frames, this.begin] = [motion, performance.now()];
  },

  draw(now) {
    for (const [name, [heights, scales]] of Object.entries(this.frames)) {
      const frame = Math.max(0, Math.min(heights.length - 1, Math.floor(((now - this.begin) / this.milliseconds) * heights.length)));
      const transform = `translate(0 ${heights[frame]})${scales ? ` scale(1 ${scales[frame]})` : ""}`;
      const part = document.getElementById(name);
      if (part && part.getAttribute("transform") !== transform) part.setAttribute("transform", transform);
    }
    // 20 steps a second are enough for the slow motion.
    setTimeout(() => requestAnimationFrame((later) => this.draw(later)), 40);
  },
};
