// What of a page cannot be read: run in it by helpers/browser.py.
function rgba(text) {
  const n = text.match(/[\d.]+/g).map(Number);
  return n.length < 4 ? [...n.slice(0, 3), 1] : n;
}
function luminance(colour) {  // WCAG's, of 0 to 1
  const parts = colour.slice(0, 3).map((v) => v / 255).map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
  return 0.2126 * parts[0] + 0.7152 * parts[1] + 0.0722 * parts[2];
}
const over = (top, below) => [0, 1, 2].map((i) => top[i] * top[3] + below[i] * (1 - top[3])).concat(1);
function ground(node) {  // the colour behind it
  const layers = [];
  for (; node; node = node.parentElement) layers.push(rgba(getComputedStyle(node).backgroundColor));
  return layers.reverse().reduce((below, layer) => over(layer, below), [255, 255, 255, 1]);
}
function faint() {
  const found = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const text = walker.currentNode.textContent.trim(), node = walker.currentNode.parentElement;
    if (!text || node.closest("script, style, svg") || !node.checkVisibility({ visibilityProperty: true })) continue;
    const style = getComputedStyle(node), paper = ground(node), size = parseFloat(style.fontSize);
    const [a, b] = [luminance(over(rgba(style.color), paper)), luminance(paper)].sort((x, y) => y - x);
    const ratio = (a + 0.05) / (b + 0.05), large = size >= 24 || (size >= 18.66 && style.fontWeight >= 700);
    if (ratio < (large ? 3 : 4.5)) found.push([text.slice(0, 40), node.tagName, Number(ratio.toFixed(2))]);
  }
  return found;
}
function nameless() {
  const texts = (e) => [e.getAttribute("aria-label"), e.title, e.alt, e.placeholder, e.textContent];
  return [...document.querySelectorAll("button, select, input, a, iframe, img, [role=img], [role=group]")]
    .filter((e) => e.checkVisibility() && !texts(e).some((text) => text && text.trim())).map((e) => e.outerHTML.slice(0, 80));
}
function badlyLaid() {
  const wide = document.documentElement.clientWidth, found = [], told = (e) => e.textContent.trim().slice(0, 40);
  for (const e of document.querySelectorAll("body *")) {
    if (!e.checkVisibility() || e.closest("svg, iframe, .wide, nav, .choices, .uplot")) continue;
    const box = e.getBoundingClientRect(), cut = e.scrollWidth > e.clientWidth + 1;
    if (box.right > wide + 1 || box.left < -1) found.push(["beyond the page", e.tagName, told(e)]);
    if (getComputedStyle(e).overflowX === "hidden" && cut && !e.title) found.push(["cut", e.tagName, told(e)]);
  }
  const kinds = "header p, header li, h2, h3, h4, .values, .note, .legend, .key li, button, select, summary";
  const texts = [...document.querySelectorAll(kinds)]  // the replay lies above the others, tables scroll
    .filter((e) => e.checkVisibility() && told(e) && !e.closest("#motion, .wide"));
  const boxes = texts.map((e) => e.getBoundingClientRect());
  for (let i = 0; i < texts.length; i++) for (let j = i + 1; j < texts.length; j++) {
    const a = boxes[i], b = boxes[j];
    const across = Math.min(a.right, b.right) - Math.max(a.left, b.left);
    const down = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
    if (across > 2 && down > 2 && !texts[i].contains(texts[j]) && !texts[j].contains(texts[i]))
      found.push(["overlap", told(texts[i]), told(texts[j])]);
  }
  return found;
}
