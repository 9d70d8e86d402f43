"use strict";
(() => {  // the replay in the colours that the reader's screen has, and still where they want no motion
  const dark = matchMedia("(prefers-color-scheme: dark)"), calm = matchMedia("(prefers-reduced-motion: reduce)");
  const paint = () => {
    const ground = ["Background", "<object>"];
    viewer.set_property(ground, "top_color", dark.matches ? [0.1, 0.13, 0.17] : [0.86, 0.89, 0.93]);
    viewer.set_property(ground, "bottom_color", dark.matches ? [0.05, 0.06, 0.08] : [0.97, 0.97, 0.98]);
    const grid = viewer.scene_tree.find(["drake", "grid"]).object;
    const lines = dark.matches ? 0x39434f : 0xb8bfc9;
    if (grid) grid.traverse((part) => { if (part.material) { part.material.vertexColors = false; part.material.color.setHex(lines); part.material.needsUpdate = true; } });
    viewer.set_dirty();
  };
  dark.addEventListener("change", paint);
  (function whenDrawn(tries) {  // the scene is read from the page itself, a little later
    if (viewer.animator && viewer.animator.actions.length) {
      paint();
      if (calm.matches) viewer.animator.pause();
    } else if (tries) setTimeout(() => whenDrawn(tries - 1), 50);
  })(200);
})();
