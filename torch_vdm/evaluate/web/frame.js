// One frame: its pictures under one zoom, what is told of it, and the plot of its map.

// `transform`: of the picture's pixels into those of a pane (d3-zoom).
const view = { row: null, transform: d3.zoomIdentity, stops: 0, top: 2, slider: 0.5, size: [0, 0], pointer: null, drawn: false };
let region = null;

// A pane shows a layer, or under the slider the left and the right one; all move together.
const panes = () => [...$("panes").querySelectorAll("canvas")];
const sliding = () => $("mode").value === "slider";
const zoom = d3.zoom().on("zoom", ({ transform }) => {
  view.transform = transform;
  for (const pane of panes()) pane.__zoom = transform; // where d3-zoom keeps it
  draw();
});
const first = () => d3.select(panes()[0]);

function layPanes() {
  const shown = sliding() ? [["left", "right"]] : [["reference"], ["test"], ["map"]];
  d3.select("#panes").classed("side", !sliding()).selectAll("figure").data(shown, String).join((entering) => {
    const figure = entering.insert("figure", "input");
    figure.append("canvas").attr("role", "img").call(zoom).on("dblclick.zoom", null).on("dblclick", fit)
      .on("pointermove", (event) => point(d3.pointer(event)))
      .on("pointerleave", () => point(null));
    figure.selectAll("figcaption").data((names) => names).join("figcaption");
    return figure;
  });
  for (const picked of document.querySelectorAll(".pick")) picked.hidden = !sliding();
  resize();
  view.size = paneSize();
}

// As high as the picture asks for; the page's style holds it to the screen, which may have changed.
function resize() {
  for (const pane of panes()) {
    pane.style.aspectRatio = `${view.row.width}/${view.row.height}`;
    const sides = [pane.clientWidth, pane.clientHeight].map((side) => Math.max(1, Math.round(side * devicePixelRatio)));
    if (pane.width !== sides[0] || pane.height !== sides[1]) [pane.width, pane.height] = sides;
  }
}

// The panes may have another size: what was fitted is fitted, and what lay in the middle stays there.
function resized() {
  if (!view.row || $("frame").hidden) return;
  const before = view.size, { k } = view.transform;
  resize();
  view.size = paneSize();
  if (Math.min(...before) > 0 && Math.abs(k / fittingScale(before) - 1) > 0.01) {
    centre(k, ...view.transform.invert(before.map((side) => side / 2)));
  } else fit();
}

const paneSize = () => [panes()[0].clientWidth, panes()[0].clientHeight];

function pictureSize() {
  const { row } = view;
  return [Math.ceil(row.width / row.block), Math.ceil(row.height / row.block)];
}

const fittingScale = (size) => Math.min(...pictureSize().map((side, at) => size[at] / side));

// The middle of a pane always shows a place of the picture, whatever moves it.
function constrained(transform, [[left, top], [right, bottom]]) {
  const middle = transform.invert([(left + right) / 2, (top + bottom) / 2]);
  return transform.translate(...pictureSize().map((side, at) => middle[at] - Math.min(side, Math.max(0, middle[at]))));
}
zoom.constrain(constrained);

// Shows a place of the picture, in its pixels, in the middle.
function centre(scale, x, y) {
  const [width, height] = view.size, fitting = fittingScale(view.size);
  if (!(width > 0 && height > 0)) return;
  zoom.scaleExtent([Math.min(1, fitting) / 2, Math.max(64, fitting)]);
  const [least, most] = zoom.scaleExtent();
  const moved = d3.zoomIdentity.translate(width / 2, height / 2).scale(Math.min(most, Math.max(least, scale))).translate(-x, -y);
  first().call(zoom.transform, constrained(moved, [[0, 0], view.size]));
}

function fit() {
  centre(fittingScale(view.size), ...pictureSize().map((side) => side / 2));
}

// A region and as much again on each side.
function goTo(at) {
  const [left, top, width, height] = at.map((size) => size / view.row.block);
  const scale = Math.min(view.size[0] / width, view.size[1] / height) / 3;
  centre(scale, left + width / 2, top + height / 2);
}

function layerNames() {
  const [reference, test, map] = view.row.pictures;
  const names = { reference, test, map };
  data.tests.forEach((_, number) => {
    const other = byKey.get(`${number} ${view.row.frame}`);
    if (other) { names[`test ${number}`] = other.pictures[1]; names[`map ${number}`] = other.pictures[2]; }
  });
  return names;
}

function choices() {
  const offered = [["reference", "reference"], ["test", testName(view.row)], ["map", `map of ${testName(view.row)}`]];
  data.tests.forEach((test, number) => {
    if (number !== view.row.test && byKey.has(`${number} ${view.row.frame}`)) {
      offered.push([`test ${number}`, test], [`map ${number}`, `map of ${test}`]);
    }
  });
  for (const [id, usual] of [["left", "reference"], ["right", "map"]]) {
    const before = $(id).value || usual;
    $(id).replaceChildren(...offered.map(([value, text]) => element("option", text, { value })));
    $(id).value = offered.some(([value]) => value === before) ? before : usual;
  }
}

const layerText = (name) => [...$("left").options].find((option) => option.value === name)?.textContent || name;

function showFrame(row, at) {
  const same = view.row && view.row.width === row.width && view.row.height === row.height;
  view.row = row;
  region = at;
  $("summary").hidden = true;
  $("frame").hidden = false;
  pressed(false);
  $("name").textContent = row.frame;
  document.title = `${row.frame}, ${testName(row)}`;
  const own = data.tests.map((test, number) => [test, number, byKey.get(`${number} ${row.frame}`)]).filter((each) => each[2]);
  $("test").replaceChildren(...own.map(([test, number]) => element("option", test, { value: number })));
  $("test").value = row.test;
  choices();
  view.top = Math.max(data.scale, Math.ceil(maximum(row) * 10) / 10);
  $("top").value = view.top;
  showScale();
  showFigures();
  showHistogram();
  if (same && view.drawn) resized(); // the window may have another size since
  layPanes();
  if (!same || !view.drawn) fit();
  if (at) goTo(at);
  draw();
}

function showFigures() {
  const row = view.row;
  $("figures").replaceChildren();
  const body = $("figures").createTBody();
  data.figures.forEach((figure, number) => {
    const line = body.insertRow();
    line.append(element("td", figure.label, { title: figure.help }), element("td", shown(figure, row.values[number])));
  });
  const line = body.insertRow();
  line.append(element("td", "size"), element("td", `${row.width} x ${row.height}`));
  $("regions").replaceChildren(...row.regions.map((place) => {
    const item = element("li");
    const button = element("button", `${place[4].toFixed(2)} JND at x ${place[0]}, y ${place[1]}`, { type: "button" });
    button.addEventListener("click", () => { region = place; goTo(place); });
    item.append(button);
    return item;
  }));
  if (!row.regions.length) $("regions").append(element("li", "no difference"));
  $("notes").replaceChildren(...row.notes.map((note) => element("li", note)));
}

function showHistogram() {
  const { counts } = view.row, total = d3.sum(counts), most = d3.max([1, ...counts]);
  const width = 300, height = 180;
  const x = d3.scaleLinear([0, counts.length], across(width)), y = d3.scaleLinear([0, 1], upwards(height));
  // The borders of bins are powers of 2^(1/3); each factor of four has a label.
  const named = (number) => { const border = data.borders[number - 1]; return border < 1 ? `1/${Math.round(1 / border)}` : String(Math.round(border)); };
  const svg = plot(width, height, `Histogram of the map: ${(100 * view.row.values[column.visible_fraction]).toFixed(1)} % of the pixels over 1 JND`,
    d3.axisBottom(x).tickValues(d3.range(1, counts.length, 6)).tickFormat(named),
    d3.axisLeft(y).tickValues([0, 0.5, 1]).tickFormat(d3.format(".0%")));
  svg.append("g").attr("class", "bars").selectAll("rect").data(counts).join("rect")
    .attr("x", (_, number) => x(number) + 0.5).attr("width", x(1) - x(0) - 1)
    .attr("y", (count) => y(count / most)).attr("height", (count) => y(0) - y(count / most));
  const over = [total, ...Array.from(d3.cumsum(counts), (below) => total - below)];
  svg.append("path").attr("class", "curve").attr("d", d3.line((_, number) => x(number), (count) => y(total ? count / total : 0))(over));
  const one = x(data.borders.findIndex((border) => Math.abs(border - 1) < 1e-9) + 1);
  svg.append("line").attr("class", "one").attr("x1", one).attr("x2", one).attr("y1", y(1)).attr("y2", y(0));
  svg.append("text").attr("x", MARGIN.left).attr("y", height - 3).text("JND; bars: pixels, line: share over it");
  $("histogram").replaceChildren(svg.node());
}

function showScale() {
  const bar = $("scale").getContext("2d");
  const image = bar.createImageData(256, 1);
  for (let step = 0; step < 256; step += 1) {
    image.data.set([...palette.slice(3 * step, 3 * step + 3), 255], 4 * step);
  }
  bar.putImageData(image, 0, 0);
  const marks = d3.ticks(0, view.top, 4).filter((tick) => tick <= 0.75 * view.top);
  $("ticks").replaceChildren(...marks.map((tick) => element("span", tick, { style: `left:${100 * tick / view.top}%` })),
    element("span", `${view.top} JND`, { style: "left:100%" }));
}

let asked = 0;
async function draw() {
  resize();
  const number = ++asked;
  $("panes").dataset.asked = number;
  const names = layerNames();
  const wanted = panes().map((pane) => [pane, sliding() ? [$("left").value, $("right").value] : d3.select(pane).datum()]);
  $("state").textContent = "";
  const late = setTimeout(() => { if (number === asked) $("state").textContent = "Loading pictures …"; }, 300);
  try {
    const ready = await Promise.all(wanted.map(([, shown]) => Promise.all(shown.map((name) => layer(names[name])))));
    await unpacked(view.row.pictures[2]); // for the value under the pointer
    if (number === asked) {
      wanted.forEach(([pane, shown], place) => paint(pane, shown, ready[place]));
      tell();
      $("panes").dataset.painted = number;
    }
  } catch (error) {
    if (number === asked) {
      for (const [pane, shown] of wanted) paint(pane, shown, []);
      tell();
      $("state").textContent = error.message;
    }
  } finally {
    clearTimeout(late);
    if (number === asked && $("state").textContent.startsWith("Loading")) $("state").textContent = "";
  }
}

function paint(pane, shown, images) {
  const context = pane.getContext("2d"), { x, y, k } = view.transform, block = view.row.block;
  const divider = Math.round(pane.width * view.slider);
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.fillStyle = "#000";
  context.fillRect(0, 0, pane.width, pane.height);
  images.forEach((image, side) => {
    context.save();
    context.beginPath();
    if (images.length > 1) context.rect(side ? divider : 0, 0, side ? pane.width - divider : divider, pane.height);
    else context.rect(0, 0, pane.width, pane.height);
    context.clip();
    context.setTransform(k * devicePixelRatio, 0, 0, k * devicePixelRatio, x * devicePixelRatio, y * devicePixelRatio);
    context.imageSmoothingEnabled = k * devicePixelRatio < 1;
    context.drawImage(image, 0, 0);
    if (region) {
      context.strokeStyle = "#39d0ff";
      context.lineWidth = 2 / k;
      context.strokeRect(region[0] / block, region[1] / block, region[2] / block, region[3] / block);
    }
    context.restore();
  });
  const texts = shown.map(layerText), [atX, atY] = view.row.peak;
  pane.parentNode.querySelectorAll("figcaption").forEach((caption, side) => { caption.textContent = texts[side]; });
  pane.setAttribute("aria-label", `${texts.join(" left and ")}${texts.length > 1 ? " right" : ""}, of frame ${view.row.frame}; `
    + `the largest difference is ${maximum(view.row).toFixed(2)} JND at x ${atX}, y ${atY}`);
}

function tell() {
  view.drawn = true;
  $("zoom").textContent = `${(100 * view.transform.k / view.row.block).toFixed(0)} %`;
  $("stops").textContent = `${view.stops > 0 ? "+" : ""}${view.stops} EV`;
  showValue();
}

// The place of a pane whose value is told; none: its middle.
function point(at) {
  view.pointer = at;
  showValue();
}

function showValue() {
  const [x, y] = view.transform.invert(view.pointer ?? view.size.map((side) => side / 2)).map(Math.floor);
  const map = decoded.get(view.row.pictures[2]), block = view.row.block;
  if (!map) { $("value").textContent = ""; return; }
  if (x < 0 || y < 0 || x >= map.width || y >= map.height) { $("value").textContent = "outside the image"; return; }
  const value = mapValue(map, y * map.width + x) / data.steps;
  const where = block === 1 ? `x ${x}, y ${y}` : `x ${x * block}, y ${y * block}, largest of ${block} x ${block}`;
  $("value").textContent = `${where}: ${value.toFixed(2)} JND`;
}

function setSlider(share) {
  view.slider = Math.min(1, Math.max(0, share));
  $("slider").value = Math.round(1000 * view.slider);
  draw();
}
