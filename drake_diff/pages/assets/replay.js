"use strict";
(() => {  // the replay in the colours that the reader's screen has, and still where they want no motion
  const dark = matchMedia("(prefers-color-scheme: dark)"), calm = matchMedia("(prefers-reduced-motion: reduce)");
  const under = (...path) => viewer.scene_tree.find(["drake", ...path]).object;
  const meshes = (object, act) => object && object.traverse((part) => { if (part.material) { act(part, part.material); part.material.needsUpdate = true; } });
  const named = (pattern, act) => meshes(under(), (part, m) => { if (pattern.test(part.name) || pattern.test(part.parent.name)) act(part, m); });
  const ARROWS = ["trail", "contacts", "thrusts"], OWN = ["motion", "level", "grid", ...ARROWS];  // all others are ghosts
  const paint = () => {
    const ground = ["Background", "<object>"];
    viewer.set_property(ground, "top_color", dark.matches ? [0.2, 0.24, 0.3] : [0.86, 0.89, 0.93]);
    viewer.set_property(ground, "bottom_color", dark.matches ? [0.11, 0.13, 0.16] : [0.97, 0.97, 0.98]);
    meshes(under("grid"), (part, m) => { m.vertexColors = false; m.color.setHex(dark.matches ? 0x4a5663 : 0xb8bfc9); });
    named(/^ground/, (part, m) => m.color.setHex(dark.matches ? 0x2c343d : 0xdde1e6));
    viewer.set_dirty();
  };
  function putBehind(ghosts) {  // a ghost shows where the motion is not: it is drawn first, whatever is nearer
    let last = null;
    meshes(under(), (part, m) => {
      if (ghosts.some((ghost) => { let at = part; while (at && at !== ghost) at = at.parent; return at; })) return;
      part.renderOrder = Math.max(part.renderOrder, m.transparent ? 3 : 2);
      m.transparent = true;  // three.js draws what is not before all that is
      if (part.isMesh) last = part;
    });
    if (!last) return;
    const curtain = last.clone();
    curtain.renderOrder = 1;
    curtain.scale.setScalar(1e-9);
    curtain.frustumCulled = false;
    curtain.onBeforeRender = (renderer) => renderer.clearDepth();
    under().add(curtain);
  }
  const prepare = () => {
    for (const name of ARROWS)  // in one colour all along, whatever light falls on them
      meshes(under(name), (part, m) => { if (m.emissive) m.emissive.copy(m.color).multiplyScalar(0.5); });
    meshes(under("motion"), (part, m) => {  // of two bodies at one place the translucent one is behind
      if (m.transparent) { m.polygonOffset = true; m.polygonOffsetFactor = 1; m.polygonOffsetUnits = 4; }
    });
    named(/^above/, (part, m) => {  // a goal is seen through what stands before it
      Object.assign(m, { depthTest: false, depthWrite: false, transparent: true, opacity: Math.min(m.opacity, 0.55) });
      part.renderOrder = 4;
    });
    const ghosts = under().children.filter((child) => !OWN.includes(child.name));
    if (ghosts.length) putBehind(ghosts);
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
