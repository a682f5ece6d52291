// Where one is, buttons and keys.

function pressed(summary) {
  $("to-summary").setAttribute("aria-pressed", summary);
  $("to-frame").setAttribute("aria-pressed", !summary);
}

function showSummary() {
  $("summary").hidden = false;
  $("frame").hidden = true;
  pressed(true);
  document.title = "Visible differences";
}

function follow() {
  if (location.hash === "#main") return; // past the head of the page
  const [, number, at] = /^#(\d+)(?:\/([\d,]+))?$/.exec(location.hash) || [];
  const row = rows[number];
  if (!row) { showSummary(); return; }
  const numbers = at ? at.split(",").map(Number) : [];
  const [left, top, width, height] = numbers;
  const there = numbers.length === 4 && left < row.width && top < row.height && width > 0 && height > 0;
  showFrame(row, there ? numbers : null);
}

function step(by) {
  const here = order.rows.indexOf(view.row);
  // One that the table does not show lies before its first row.
  const from = here < 0 && by < 0 ? 0 : here;
  const next = order.rows[(from + by + order.rows.length) % order.rows.length];
  if (next) open(next);
}

function nextTest() {
  for (let by = 1; by <= data.tests.length; by += 1) {
    const other = byKey.get(`${(view.row.test + by) % data.tests.length} ${view.row.frame}`);
    if (other && other !== view.row) { open(other); return; }
  }
}

function toggleMap() {
  $("right").value = $("right").value === "map" ? "test" : "map";
  draw();
}

function setMode(mode) {
  $("mode").value = mode;
  if (document.activeElement === $("slider")) $("panes").focus();
  view.pointer = null; // its pane may be gone
  layPanes();
  fit();
}

function setStops(stops) {
  view.stops = Math.min(8, Math.max(-8, stops));
  $("exposure").value = view.stops;
  draw();
}

function toggleTheme() {
  const root = document.documentElement;
  const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
}

const zoomBy = (factor) => first().call(zoom.scaleBy, factor);

const KEYS = [
  ["n", "next frame of the table", () => step(1)],
  ["p", "previous frame", () => step(-1)],
  ["t", "next test", nextTest],
  ["m", "map or test at the right", toggleMap],
  ["v", "slider, or side by side", () => setMode(sliding() ? "side" : "slider")],
  ["[", "slider to the left", () => setSlider(view.slider - 0.05)],
  ["]", "slider to the right", () => setSlider(view.slider + 0.05)],
  ["+", "zoom in", () => zoomBy(1.5)],
  ["-", "zoom out", () => zoomBy(1 / 1.5)],
  ["0", "fit", fit],
  ["1", "one pixel on one", () => first().call(zoom.scaleTo, 1)],
  ["e", "darker by half a stop", () => setStops(view.stops - 0.5)],
  ["E", "brighter by half a stop", () => setStops(view.stops + 0.5)],
];
const MORE_KEYS = [
  ["arrows", "move, on the picture; with shift by one pixel"], ["d", "light or dark"],
  ["Esc", "back to the summary"], ["?", "these keys"],
];
const MOVES = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || $("help").open) return;
  if (event.target.closest("input[type=search], input[type=number], select")) return;
  if (event.key === "?") { $("help").showModal(); return; }
  if (event.key === "d") { toggleTheme(); return; }
  if ($("frame").hidden) return;
  if (event.key === "Escape") { location.hash = ""; return; }
  if (event.target === $("panes") && MOVES[event.key]) {
    event.preventDefault();
    // A tenth of the view; with shift one pixel of the picture.
    const size = event.shiftKey ? 1 : view.size[0] / 10 / view.transform.k;
    view.pointer = null;
    first().call(zoom.translateBy, ...MOVES[event.key].map((way) => way * size));
    return;
  }
  const found = KEYS.find(([key]) => key === event.key);
  if (found) { event.preventDefault(); found[2](); }
});

const CLICKS = {
  "to-summary": () => { location.hash = ""; },
  "to-frame": () => { const row = view.row || order.rows[0] || rows[0]; if (row) open(row); },
  previous: () => step(-1),
  next: () => step(1),
  in: () => zoomBy(1.5),
  out: () => zoomBy(1 / 1.5),
  fit,
  theme: toggleTheme,
  keys: () => $("help").showModal(),
};
for (const [id, act] of Object.entries(CLICKS)) $(id).addEventListener("click", act);
$("test").addEventListener("change", () => open(byKey.get(`${$("test").value} ${view.row.frame}`)));
$("mode").addEventListener("change", () => setMode($("mode").value));
$("left").addEventListener("change", draw);
$("right").addEventListener("change", draw);
$("exposure").addEventListener("input", () => setStops(Number($("exposure").value)));
$("slider").addEventListener("input", () => setSlider($("slider").value / 1000));
$("top").addEventListener("change", () => {
  const top = Number($("top").value);
  if (top > 0 && Number.isFinite(top)) { view.top = top; showScale(); draw(); }
  $("top").value = view.top;
});
for (const [key, what] of [...KEYS, ...MORE_KEYS]) $("help").querySelector("dl").append(element("dt", key), element("dd", what));
$("slider").addEventListener("wheel", (event) => {
  event.preventDefault();
  panes()[0].dispatchEvent(new WheelEvent("wheel", event));
}, { passive: false });
addEventListener("resize", resized);
new ResizeObserver(resized).observe($("panes"));
addEventListener("hashchange", follow);

showVerdicts();
showTests();
showCourse();
showWorst();
showTable();
showRest();
follow();
