"use strict";
(() => {  // the replay in the colours that the reader's screen has, and still where they want no motion
  const dark = matchMedia("(prefers-color-scheme: dark)"), calm = matchMedia("(prefers-reduced-motion: reduce)");
  const under = (...path) => viewer.scene_tree.find(["drake", ...path]).object;
  const materials = (object, act) => object && object.traverse((part) => { if (part.material) { act(part.material); part.material.needsUpdate = true; } });
  const paint = () => {
    const ground = ["Background", "<object>"];
    viewer.set_property(ground, "top_color", dark.matches ? [0.2, 0.24, 0.3] : [0.86, 0.89, 0.93]);
    viewer.set_property(ground, "bottom_color", dark.matches ? [0.11, 0.13, 0.16] : [0.97, 0.97, 0.98]);
    materials(under("grid"), (m) => { m.vertexColors = false; m.color.setHex(dark.matches ? 0x4a5663 : 0xb8bfc9); });
    viewer.set_dirty();
  };
  const prepare = () => {
    for (const name of ["trail", "contacts", "thrusts"])  // in one colour all along, whatever light falls on them
      materials(under(name), (m) => { if (m.emissive) m.emissive.copy(m.color).multiplyScalar(0.5); });
    materials(under(), (m) => {  // a ghost where the motion is, is behind it
      if (m.transparent) { m.polygonOffset = true; m.polygonOffsetFactor = 1; m.polygonOffsetUnits = 4; }
    });
  };
  dark.addEventListener("change", paint);
  (function whenDrawn(tries) {  // the scene is read from the page itself, a little later
    if (viewer.animator && viewer.animator.actions.length) {
      prepare();
      paint();
      if (calm.matches) viewer.animator.pause();
    } else if (tries) setTimeout(() => whenDrawn(tries - 1), 50);
  })(200);
})();
