"use strict";
// The report's script. Foreign text (names, notes) goes into the page as text only, never as markup.

const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const COLOURS = ["#2f7ed8", "#d9822b", "#2a9d5c", "#b0479e", "#8a6d3b", "#d1495b", "#00838f", "#6a5acd"];
const DASHES = ["", "6 3", "2 3"], STROKES = ["solid", "dashed", "dotted"];
const PAGE = 200; // rows of the table that are shown at once
const KEPT = 9; // decoded pictures, and layers drawn from them, that are kept
const rows = data.rows.map((row, number) => ({
  number, frame: row[0], test: row[1], values: row[2], width: row[3][0], height: row[3][1],
  peak: row[4], counts: row[5], regions: row[6], pictures: row[7], block: row[8], notes: row[9],
}));
const column = Object.fromEntries(data.figures.map((figure, number) => [figure.name, number]));
const maximum = (row) => row.values[column.max_jnd];
const testName = (row) => data.tests[row.test];
const place = (path) => path.split("/").map(encodeURIComponent).join("/");
const thumbnail = (row) => `${place(data.maps)}/${place(testName(row))}/${place(row.frame)}.png`;
const byKey = new Map(rows.map((row) => [`${row.test} ${row.frame}`, row]));

function element(tag, text, attributes) {
  const made = document.createElement(tag);
  if (text !== undefined && text !== null) made.textContent = text;
  for (const [name, value] of Object.entries(attributes || {})) made.setAttribute(name, value);
  return made;
}

function drawn(tag, attributes, text) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

function shown(figure, value) {
  if (value === null || value === undefined) return "–";
  const number = figure.percent ? value * 100 : value;
  const text = number.toFixed(figure.digits).replace(/^-(0\.?0*)$/, "$1");
  const sign = figure.name === "mean_luminance_change" && Number(text) > 0 ? "+" : "";
  return sign + text + (figure.percent ? " %" : "");
}

const plural = (count, what) => `${count} ${what}${count === 1 ? "" : "s"}`;

// Summary -------------------------------------------------------------------------------------

function median(values) {
  const sorted = [...values].sort((a, b) => a - b);
  const middle = sorted.length >> 1;
  return sorted.length % 2 ? sorted[middle] : (sorted[middle - 1] + sorted[middle]) / 2;
}

function showVerdicts() {
  const over = data.fail_above === null ? [] : rows.filter((row) => maximum(row) > data.fail_above);
  const skipped = data.skipped.length ? `, ${data.skipped.length} skipped` : "";
  $("verdicts").append(element("p",
    `${plural(data.tests.length, "test")}, ${plural(rows.length, "comparison")}${skipped}.`, { class: "lead" }));
  if (data.fail_above !== null) {
    $("verdicts").append(element("p", over.length
      ? `${plural(over.length, "comparison")} over ${data.fail_above} JND.`
      : `None is over ${data.fail_above} JND.`, over.length ? { class: "bad" } : {}));
  }
  for (const sentence of data.sentences) $("verdicts").append(element("p", sentence));
}

function showTests() {
  const own = data.tests.map((_, number) => rows.filter((row) => row.test === number));
  const head = $("tests").createTHead().insertRow();
  head.append(element("td"));
  for (const test of data.tests) head.append(element("th", test, { scope: "col" }));
  const body = $("tests").createTBody();
  const add = (label, help, tell) => {
    const line = body.insertRow();
    line.append(element("th", label, { scope: "row", title: help }));
    for (const some of own) line.append(element("td", some.length ? tell(some) : "–"));
  };
  add("frames", "Frames that were compared", (some) => some.length);
  add("worst max", "The largest difference in any frame, JND", (some) => some.reduce((most, row) => Math.max(most, maximum(row)), 0).toFixed(2));
  data.figures.forEach((figure, place) => add(figure.label, figure.help, (some) => {
    const values = some.map((row) => row.values[place]).filter((value) => value !== null);
    return values.length ? shown(figure, median(values)) : "–";
  }));
}

function showCourse() {
  const frames = [...new Set(rows.map((row) => row.frame))];
  const place = new Map(frames.map((frame, number) => [frame, number]));
  if (!rows.length) return;
  const width = Math.max(300, $("course").clientWidth), height = Math.min(300, 150 + width / 4), left = 38, bottom = 24;
  const top = rows.reduce((most, row) => Math.max(most, maximum(row)), 1.2);
  const x = (frame) => left + (width - left - 8) * (frames.length > 1 ? place.get(frame) / (frames.length - 1) : 0.5);
  const y = (jnd) => (height - bottom) - (height - bottom - 8) * jnd / top;
  const svg = drawn("svg", {
    viewBox: `0 0 ${width} ${height}`, role: "img",
    "aria-label": `Largest difference of ${plural(frames.length, "frame")}, up to ${top.toFixed(2)} JND`,
  });
  for (const tick of ticks(top, 4)) {
    svg.append(drawn("line", { class: "grid", x1: left, x2: width - 8, y1: y(tick), y2: y(tick) }));
    svg.append(drawn("text", { x: left - 6, y: y(tick) + 4, "text-anchor": "end" }, String(tick)));
  }
  svg.append(drawn("line", { class: "one", x1: left, x2: width - 8, y1: y(1), y2: y(1) }));
  svg.append(drawn("text", { x: left, y: height - 6 }, short(frames[0])));
  if (frames.length > 1) {
    svg.append(drawn("text", { x: width - 8, y: height - 6, "text-anchor": "end" }, short(frames[frames.length - 1])));
  }
  data.tests.forEach((test, number) => {
    const own = rows.filter((row) => row.test === number);
    const colour = COLOURS[number % COLOURS.length];
    const points = own.map((row) => `${x(row.frame).toFixed(1)},${y(maximum(row)).toFixed(1)}`).join(" ");
    svg.append(drawn("polyline", {
      points, fill: "none", stroke: colour, "stroke-width": 1.6, "stroke-dasharray": DASHES[number % DASHES.length],
    }));
    if (own.length <= 60) {
      for (const row of own) svg.append(drawn("circle", { cx: x(row.frame), cy: y(maximum(row)), r: 2.5, fill: colour }));
    }
    const entry = element("span");
    entry.append(element("i", null, { style: `border-top:3px ${STROKES[number % STROKES.length]} ${colour}` }), test);
    $("legend").append(entry);
  });
  svg.addEventListener("click", (event) => {
    const box = svg.getBoundingClientRect();
    const here = { x: (event.clientX - box.left) * width / box.width, y: (event.clientY - box.top) * height / box.height };
    const away = (row) => Math.hypot(x(row.frame) - here.x, (y(maximum(row)) - here.y) / 4);
    open(rows.reduce((best, row) => (away(row) < away(best) ? row : best)));
  });
  svg.style.cursor = "pointer";
  $("course").append(svg);
}

const short = (text) => (text.length > 28 ? `…${text.slice(-27)}` : text);

function ticks(top, count) {
  const rough = top / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((size) => size >= rough);
  const found = [];
  for (let number = 0; number * step <= top; number += 1) found.push(+(number * step).toPrecision(6));
  return found;
}

function showWorst() {
  const all = rows.flatMap((row) => row.regions.map((region) => ({ row, region })));
  all.sort((a, b) => b.region[4] - a.region[4]);
  for (const { row, region } of all.slice(0, 20)) {
    const link = element("a", null, { href: address(row, region) });
    const box = element("span", null, { class: "picture" });
    const inner = element("span", null, { style: `aspect-ratio:${row.width}/${row.height}` });
    inner.append(element("img", null, {
      loading: "lazy", decoding: "async", src: thumbnail(row),
      alt: `Map of ${row.frame}, ${testName(row)}`,
    }));
    const share = [region[0] / row.width, region[1] / row.height, region[2] / row.width, region[3] / row.height];
    const sides = ["left", "top", "width", "height"];
    inner.append(element("i", null, { style: sides.map((side, at) => `${side}:${100 * share[at]}%`).join(";") }));
    box.append(inner);
    link.append(box, element("span",
      `${region[4].toFixed(2)} JND, ${row.frame}, ${testName(row)}, at x ${region[0]}, y ${region[1]}`, { class: "caption" }));
    $("worst").append(link);
  }
  if (!all.length) $("worst").append(element("p", "No difference anywhere."));
}

// The table: sorted and filtered as data; only some of its rows are in the page.
const order = { by: column.max_jnd, descending: true, shown: PAGE, rows: rows };

function sortValue(row) {
  if (order.by === "frame") return row.number;
  if (order.by === "test") return row.test * rows.length + row.number;
  return row.values[order.by];
}

function arrange() {
  const wanted = $("filter").value.toLowerCase();
  const sign = order.descending ? -1 : 1;
  order.rows = rows.filter((row) => `${row.frame} ${testName(row)}`.toLowerCase().includes(wanted));
  order.rows.sort((a, b) => {
    const one = sortValue(a), other = sortValue(b);
    if (one === null || other === null) return (one === null) - (other === null) || a.number - b.number;
    return sign * (one - other) || a.number - b.number;
  });
  fillTable();
}

function fillTable() {
  const body = element("tbody");
  for (const row of order.rows.slice(0, order.shown)) {
    const line = body.insertRow();
    const cell = line.insertCell();
    cell.append(element("a", row.frame, { href: address(row) }));
    line.append(element("td", testName(row), { class: "text" }));
    data.figures.forEach((figure, number) => {
      const over = figure.name === "max_jnd" && data.fail_above !== null && row.values[number] > data.fail_above;
      line.append(element("td", shown(figure, row.values[number]), over ? { class: "bad" } : {}));
    });
    line.addEventListener("click", (event) => {
      if (!event.target.closest("a")) open(row);
    });
  }
  $("frames").tBodies[0].replaceWith(body);
  $("found").textContent = `${order.rows.length} of ${rows.length}`;
  $("more").hidden = order.shown >= order.rows.length;
  for (const head of $("frames").tHead.rows[0].cells) {
    const here = head.dataset.by === String(order.by);
    head.setAttribute("aria-sort", here ? (order.descending ? "descending" : "ascending") : "none");
  }
}

function showTable() {
  const head = $("frames").createTHead().insertRow();
  const add = (label, by, better, help) => {
    const cell = element("th", null, { scope: "col", title: help, class: typeof by === "string" ? "text" : "" });
    cell.dataset.by = by;
    const button = element("button", label, { type: "button" });
    button.addEventListener("click", () => {
      // The worst first; names from the first on.
      order.descending = order.by === by ? !order.descending : better === false;
      order.by = by;
      order.shown = PAGE;
      arrange();
    });
    cell.append(button);
    head.append(cell);
  };
  add("frame", "frame", true, "Name of the frame");
  add("test", "test", true, "Name of the test");
  data.figures.forEach((figure, number) => add(figure.label, number, figure.more_is_better, figure.help));
  $("frames").append(element("tbody"));
  $("filter").addEventListener("input", () => { order.shown = PAGE; arrange(); });
  $("more").addEventListener("click", () => { order.shown += 5 * PAGE; fillTable(); });
  arrange();
}

function showRest() {
  if (data.skipped.length) {
    $("skipped").hidden = false;
    $("skipped").querySelector("summary").textContent = `Skipped: ${plural(data.skipped.length, "comparison")}`;
    for (const cells of data.skipped) {
      const line = $("skipped").querySelector("table").insertRow();
      for (const cell of cells) line.append(element("td", cell));
    }
  }
  for (const assumed of data.assumptions) $("settings").querySelector("ul").append(element("li", assumed));
  for (const [name, value] of data.settings) {
    const line = $("settings").querySelector("table").insertRow();
    line.append(element("td", name), element("td", value));
  }
}

// Pictures ------------------------------------------------------------------------------------

// Each lies in a script beside the page, for a page from a disk may not read the pixels of images.
const arriving = new Map();
const decoded = new Map();
const layers = new Map();

function keep(cache, key, value) {
  cache.delete(key);
  cache.set(key, value);
  if (cache.size > KEPT) cache.delete(cache.keys().next().value);
  return value;
}

window.picture = (name, width, height, kind, text) => arriving.get(name)?.take({ width, height, kind, text });

function arrived(name) {
  if (!arriving.has(name)) {
    const waiting = {};
    waiting.promise = new Promise((resolve, reject) => {
      waiting.take = resolve;
      const script = element("script", null, { src: `${place(data.pictures)}/${place(name)}.js` });
      script.addEventListener("load", () => script.remove());
      script.addEventListener("error", () => {
        script.remove();
        reject(new Error("A picture is missing: keep the folders beside the page."));
      });
      document.head.append(script);
    });
    arriving.set(name, waiting);
  }
  return arriving.get(name).promise.finally(() => arriving.delete(name));
}

async function unpacked(name) {
  if (decoded.has(name)) return keep(decoded, name, decoded.get(name));
  const { width, height, kind, text } = await arrived(name);
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  for (let begin = 0; begin < bytes.length; begin += width) {
    for (let place = begin + 1; place < begin + width; place += 1) bytes[place] += bytes[place - 1];
  }
  return keep(decoded, name, { width, height, kind, bytes });
}

// Hundredths of a JND.
function mapValue(picture, place) {
  const size = picture.width * picture.height;
  return picture.bytes[place] * 65536 + picture.bytes[size + place] * 256 + picture.bytes[2 * size + place];
}

const palette = Uint8Array.from(atob(data.palette), (letter) => letter.charCodeAt(0));
const encode = (light) => (light <= 0.0031308 ? 12.92 * light : 1.055 * light ** (1 / 2.4) - 0.055);
const decode = (code) => (code <= 0.04045 ? code / 12.92 : ((code + 0.055) / 1.055) ** 2.4);

// Bytes for the screen, for each exponent and mantissa of a picture of light.
const tables = new Map();
function lightTable(stops) {
  if (!tables.has(stops)) {
    tables.clear();
    const table = new Uint8ClampedArray(65536);
    for (let exponent = 0; exponent < 256; exponent += 1) {
      for (let mantissa = 0; mantissa < 256; mantissa += 1) {
        table[exponent * 256 + mantissa] = 255 * Math.min(1, encode(mantissa * 2 ** (exponent - 136 + stops)));
      }
    }
    tables.set(stops, table);
  }
  return tables.get(stops);
}

function codedTable(stops) {
  return Uint8ClampedArray.from({ length: 256 }, (_, code) => (
    stops === 0 ? code : 255 * Math.min(1, encode(decode(code / 255) * 2 ** stops))));
}

async function layer(name) {
  const source = await unpacked(name);
  const key = source.kind === "map" ? `${name} ${view.top}` : `${name} ${view.stops}`;
  if (layers.has(key)) return keep(layers, key, layers.get(key));
  const canvas = document.createElement("canvas");
  canvas.width = source.width;
  canvas.height = source.height;
  const context = canvas.getContext("2d");
  const image = context.createImageData(source.width, source.height);
  const { bytes, kind } = source, size = source.width * source.height, out = image.data;
  const table = kind === "light" ? lightTable(view.stops) : codedTable(view.stops);
  for (let place = 0, at = 0; place < size; place += 1, at += 4) {
    if (kind === "map") {
      const step = 3 * Math.min(255, Math.round(255 * mapValue(source, place) / (data.steps * view.top)));
      out[at] = palette[step]; out[at + 1] = palette[step + 1]; out[at + 2] = palette[step + 2];
    } else {
      const row = kind === "light" ? bytes[3 * size + place] * 256 : 0;
      for (let channel = 0; channel < 3; channel += 1) out[at + channel] = table[row + bytes[channel * size + place]];
    }
    out[at + 3] = 255;
  }
  context.putImageData(image, 0, 0);
  return keep(layers, key, canvas);
}

// The frame -----------------------------------------------------------------------------------

// `scale` is screen pixels for a picture's pixel; `x`, `y` the picture's place in the middle of a pane.
const view = { row: null, scale: 1, x: 0, y: 0, stops: 0, top: 2, slider: 0.5, pointer: null, drawn: false };
const canvas = $("canvas");
const context = canvas.getContext("2d");
let region = null;

const address = (row, at) => `#${row.number}${at ? `/${at.slice(0, 4).join(",")}` : ""}`;
function open(row, at) { location.hash = address(row, at); }

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
  resize();
  if (at) goTo(at);
  else if (!same || !view.drawn) fit();
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
    button.addEventListener("click", () => { region = place; goTo(place); draw(); });
    item.append(button);
    return item;
  }));
  if (!row.regions.length) $("regions").append(element("li", "no difference"));
  $("notes").replaceChildren(...row.notes.map((note) => element("li", note)));
}

function showHistogram() {
  const { counts } = view.row, borders = data.borders;
  const total = counts.reduce((sum, count) => sum + count, 0);
  const most = counts.reduce((a, b) => Math.max(a, b), 1);
  const width = 300, height = 170, left = 42, bottom = 34, top = 8, right = 6;
  const x = (border) => left + (width - left - right) * border / counts.length;
  const y = (share) => (height - bottom) - (height - bottom - top) * share;
  const svg = drawn("svg", { viewBox: `0 0 ${width} ${height}`, role: "img" });
  for (const tick of [0, 0.5, 1]) {
    svg.append(drawn("line", { class: "grid", x1: left, x2: width - right, y1: y(tick), y2: y(tick) }));
    svg.append(drawn("text", { x: left - 4, y: y(tick) + 4, "text-anchor": "end" }, `${tick * 100} %`));
  }
  let over = total;
  const points = [`${x(0)},${y(total ? 1 : 0)}`];
  counts.forEach((count, number) => {
    svg.append(drawn("rect", {
      class: "bars", x: x(number) + 0.5, width: x(1) - x(0) - 1, y: y(count / most), height: y(0) - y(count / most),
    }));
    over -= count;
    points.push(`${x(number + 1).toFixed(1)},${y(over / total).toFixed(1)}`);
  });
  svg.append(drawn("polyline", { class: "curve", points: points.join(" ") }));
  borders.forEach((border, number) => {
    if (Math.abs(border - 1) < 1e-9) svg.append(drawn("line", { class: "one", x1: x(number + 1), x2: x(number + 1), y1: top, y2: y(0) }));
    if (number % 6 === 0) svg.append(drawn("text", { x: x(number + 1), y: height - 18, "text-anchor": "middle" }, border < 1 ? `1/${Math.round(1 / border)}` : String(Math.round(border))));
  });
  svg.append(drawn("text", { x: left, y: height - 3 }, "JND; bars: pixels, line: share over it"));
  const visible = view.row.values[column.visible_fraction];
  svg.setAttribute("aria-label", `Histogram of the map: ${(100 * visible).toFixed(1)} % of the pixels over 1 JND`);
  $("histogram").replaceChildren(svg);
}

function showScale() {
  const bar = $("scale").getContext("2d");
  const image = bar.createImageData(256, 1);
  for (let step = 0; step < 256; step += 1) {
    image.data.set([...palette.slice(3 * step, 3 * step + 3), 255], 4 * step);
  }
  bar.putImageData(image, 0, 0);
  const marks = ticks(view.top, 4);
  const last = marks[marks.length - 1];
  if (last > 0.75 * view.top) marks.pop();
  $("ticks").replaceChildren(...marks.map((tick) => element("span", tick, { style: `left:${100 * tick / view.top}%` })),
    element("span", `${view.top} JND`, { style: "left:100%" }));
}

// Panes: one under the slider, or three side by side (below one another where that is larger).
function panes() {
  const { width, height } = canvas;
  if ($("mode").value === "slider") return [{ x: 0, y: 0, width, height, layers: [$("left").value, $("right").value] }];
  const across = width / view.row.width > height / view.row.height;
  const gap = Math.round(2 * devicePixelRatio);
  return ["reference", "test", "map"].map((name, number) => {
    const size = ((across ? width : height) - 2 * gap) / 3;
    const begin = number * (size + gap);
    return across
      ? { x: begin, y: 0, width: size, height, layers: [name] }
      : { x: 0, y: begin, width, height: size, layers: [name] };
  });
}

function pictureSize() {
  const { row } = view;
  return { width: Math.ceil(row.width / row.block), height: Math.ceil(row.height / row.block) };
}

function fit() {
  const pane = panes()[0], size = pictureSize();
  view.scale = Math.min(pane.width / size.width, pane.height / size.height);
  view.x = size.width / 2;
  view.y = size.height / 2;
}

function goTo(at) {
  const pane = panes()[0], block = view.row.block;
  view.scale = Math.min(pane.width / (3 * at[2] / block), pane.height / (3 * at[3] / block));
  view.x = (at[0] + at[2] / 2) / block;
  view.y = (at[1] + at[3] / 2) / block;
}

function zoom(factor, place) {
  const pane = panes()[0], size = pictureSize();
  const fitting = Math.min(pane.width / size.width, pane.height / size.height);
  const scale = Math.min(64 * devicePixelRatio, Math.max(Math.min(1, fitting) / 2, view.scale * factor));
  if (place) {
    // What lies under the pointer stays there.
    view.x = place.x + (view.x - place.x) * view.scale / scale;
    view.y = place.y + (view.y - place.y) * view.scale / scale;
  }
  view.scale = scale;
  draw();
}

function pan(right, down) {
  const size = pictureSize();
  view.x = Math.min(size.width, Math.max(0, view.x + right / view.scale));
  view.y = Math.min(size.height, Math.max(0, view.y + down / view.scale));
  draw();
}

function resize() {
  // As high as the picture asks for; the page's style holds it to the screen.
  const { row } = view, wide = canvas.parentElement.clientWidth > 700;
  const across = $("mode").value === "slider" ? 1 : wide ? 3 : 1 / 3;
  canvas.style.aspectRatio = String(across * row.width / row.height);
  const box = canvas.getBoundingClientRect();
  canvas.width = Math.max(1, Math.round(box.width * devicePixelRatio));
  canvas.height = Math.max(1, Math.round(box.height * devicePixelRatio));
}

let asked = 0;
async function draw() {
  if (!view.row) return;
  const number = ++asked;
  canvas.dataset.asked = number;
  const names = layerNames();
  const wanted = panes();
  $("state").textContent = "";
  const late = setTimeout(() => { $("state").textContent = "Loading pictures …"; }, 300);
  try {
    const ready = await Promise.all(wanted.map((pane) => Promise.all(pane.layers.map((name) => layer(names[name])))));
    await unpacked(view.row.pictures[2]); // for the value under the pointer
    if (number === asked) {
      paint(wanted, ready);
      canvas.dataset.painted = number;
    }
  } catch (error) {
    if (number === asked) { $("state").textContent = error.message; }
  } finally {
    clearTimeout(late);
    if (number === asked && $("state").textContent.startsWith("Loading")) $("state").textContent = "";
  }
}

function paint(wanted, ready) {
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.fillStyle = "#000";
  context.fillRect(0, 0, canvas.width, canvas.height);
  wanted.forEach((pane, number) => {
    const divider = pane.x + pane.width * view.slider;
    ready[number].forEach((image, side) => {
      context.save();
      context.beginPath();
      if (ready[number].length === 1) context.rect(pane.x, pane.y, pane.width, pane.height);
      else if (side === 0) context.rect(pane.x, pane.y, divider - pane.x, pane.height);
      else context.rect(divider, pane.y, pane.x + pane.width - divider, pane.height);
      context.clip();
      context.translate(pane.x + pane.width / 2, pane.y + pane.height / 2);
      context.scale(view.scale, view.scale);
      context.translate(-view.x, -view.y);
      context.imageSmoothingEnabled = view.scale < 1;
      context.drawImage(image, 0, 0);
      if (region) {
        const block = view.row.block;
        context.strokeStyle = "#39d0ff";
        context.lineWidth = 2 * devicePixelRatio / view.scale;
        context.strokeRect(region[0] / block, region[1] / block, region[2] / block, region[3] / block);
      }
      context.restore();
    });
    label(pane);
    if (pane.layers.length === 2) {
      context.fillStyle = "#fff";
      context.fillRect(divider - devicePixelRatio, pane.y, 2 * devicePixelRatio, pane.height);
    }
  });
  $("zoom").textContent = `${(100 * view.scale / view.row.block / devicePixelRatio).toFixed(0)} %`;
  $("stops").textContent = `${view.stops > 0 ? "+" : ""}${view.stops} EV`;
  const what = wanted.map((pane) => pane.layers.map(layerText).join(" left and ") + (pane.layers.length > 1 ? " right" : "")).join(", ");
  const [x, y] = view.row.peak;
  canvas.setAttribute("aria-label", `${what}, of frame ${view.row.frame}; the largest difference is ${maximum(view.row).toFixed(2)} JND at x ${x}, y ${y}`);
  view.drawn = true;
  showValue();
}

function layerText(name) {
  return [...$("left").options].find((option) => option.value === name)?.textContent || name;
}

function label(pane) {
  const size = 12 * devicePixelRatio;
  context.font = `${size}px system-ui, sans-serif`;
  context.textBaseline = "top";
  pane.layers.forEach((name, side) => {
    const text = layerText(name).slice(0, 40);
    const width = context.measureText(text).width + size;
    const x = side ? pane.x + pane.width - width - 6 : pane.x + 6;
    context.fillStyle = "rgba(0, 0, 0, 0.65)";
    context.fillRect(x, pane.y + 6, width, size * 1.6);
    context.fillStyle = "#fff";
    context.fillText(text, x + size / 2, pane.y + 6 + size * 0.3);
  });
}

// Where a place of the canvas lies in the picture.
function under(x, y) {
  const pane = panes().find((each) => x >= each.x && x < each.x + each.width && y >= each.y && y < each.y + each.height);
  if (!pane) return null;
  return {
    x: view.x + (x - pane.x - pane.width / 2) / view.scale,
    y: view.y + (y - pane.y - pane.height / 2) / view.scale,
  };
}

function showValue() {
  const place = view.pointer || { x: view.x, y: view.y };
  const x = Math.floor(place.x), y = Math.floor(place.y), block = view.row.block;
  const map = decoded.get(view.row.pictures[2]);
  if (!map || x < 0 || y < 0 || x >= map.width || y >= map.height) { $("value").textContent = "outside the image"; return; }
  const value = mapValue(map, y * map.width + x) / data.steps;
  const where = block === 1 ? `x ${x}, y ${y}` : `x ${x * block}, y ${y * block}, largest of ${block} x ${block}`;
  $("value").textContent = `${where}: ${value.toFixed(2)} JND`;
}

function placeOf(event) {
  const box = canvas.getBoundingClientRect();
  return { x: (event.clientX - box.left) * devicePixelRatio, y: (event.clientY - box.top) * devicePixelRatio };
}

function setSlider(share) {
  view.slider = Math.min(1, Math.max(0, share));
  $("slider").value = Math.round(1000 * view.slider);
  draw();
}

const touching = new Map();
let dragging = null;
canvas.addEventListener("pointerdown", (event) => {
  const place = placeOf(event);
  canvas.setPointerCapture(event.pointerId);
  touching.set(event.pointerId, place);
  const near = $("mode").value === "slider" && Math.abs(place.x - canvas.width * view.slider) < 12 * devicePixelRatio;
  dragging = near ? "slider" : "pan";
});
canvas.addEventListener("pointermove", (event) => {
  const place = placeOf(event), before = touching.get(event.pointerId);
  view.pointer = under(place.x, place.y);
  if (!before) {
    const near = $("mode").value === "slider" && Math.abs(place.x - canvas.width * view.slider) < 12 * devicePixelRatio;
    canvas.style.cursor = near ? "ew-resize" : "crosshair";
  } else if (touching.size === 2) {
    const other = [...touching].find(([id]) => id !== event.pointerId)[1];
    const apart = (one) => Math.hypot(one.x - other.x, one.y - other.y);
    zoom(apart(place) / Math.max(1, apart(before)), under((place.x + other.x) / 2, (place.y + other.y) / 2));
  } else if (dragging === "slider") {
    setSlider(place.x / canvas.width);
  } else {
    pan(before.x - place.x, before.y - place.y);
  }
  if (before) touching.set(event.pointerId, place);
  if (view.row) showValue();
});
for (const type of ["pointerup", "pointercancel"]) {
  canvas.addEventListener(type, (event) => { touching.delete(event.pointerId); });
}
canvas.addEventListener("pointerleave", () => { view.pointer = null; });
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  const place = placeOf(event);
  zoom(2 ** (-event.deltaY / 300), under(place.x, place.y));
}, { passive: false });
canvas.addEventListener("dblclick", () => { fit(); draw(); });

// Controls ------------------------------------------------------------------------------------

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
  const [, number, at] = /^#(\d+)(?:\/([\d,]+))?$/.exec(location.hash) || [];
  const row = rows[number];
  if (!row) { showSummary(); return; }
  const numbers = at ? at.split(",").map(Number) : [];
  showFrame(row, numbers.length === 4 ? numbers : null);
}

function step(by) {
  const here = order.rows.indexOf(view.row);
  const next = order.rows[(here + by + order.rows.length) % order.rows.length];
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

const KEYS = [
  ["n", "next frame of the table", () => step(1)],
  ["p", "previous frame", () => step(-1)],
  ["t", "next test", nextTest],
  ["m", "map or test at the right", toggleMap],
  ["v", "slider, or side by side", () => { $("mode").value = $("mode").value === "slider" ? "side" : "slider"; changeMode(); }],
  ["[", "slider to the left", () => setSlider(view.slider - 0.05)],
  ["]", "slider to the right", () => setSlider(view.slider + 0.05)],
  ["+", "zoom in", () => zoom(1.5)],
  ["-", "zoom out", () => zoom(1 / 1.5)],
  ["0", "fit", () => { fit(); draw(); }],
  ["1", "one pixel on one", () => { view.scale = devicePixelRatio; draw(); }],
  ["e", "darker by half a stop", () => setStops(view.stops - 0.5)],
  ["E", "brighter by half a stop", () => setStops(view.stops + 0.5)],
];

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || $("help").open) return;
  if (event.target.closest("input[type=search], input[type=number], select")) return;
  if (event.key === "?") { $("help").showModal(); return; }
  if (event.key === "d") { toggleTheme(); return; }
  if ($("frame").hidden) return;
  if (event.key === "Escape") { location.hash = ""; return; }
  const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  if (event.target === canvas && moves[event.key]) {
    event.preventDefault();
    // A tenth of the view; with shift one pixel of the picture.
    const size = event.shiftKey ? view.scale : canvas.width / 10;
    view.pointer = null;
    pan(moves[event.key][0] * size, moves[event.key][1] * size);
    return;
  }
  const found = KEYS.find(([key]) => key === event.key);
  if (found) { event.preventDefault(); found[2](); }
});

function changeMode() {
  for (const picked of document.querySelectorAll(".pick")) picked.hidden = $("mode").value !== "slider";
  resize();
  fit();
  draw();
}

$("to-summary").addEventListener("click", () => { location.hash = ""; });
$("to-frame").addEventListener("click", () => { const row = view.row || order.rows[0]; if (row) open(row); });
$("previous").addEventListener("click", () => step(-1));
$("next").addEventListener("click", () => step(1));
$("test").addEventListener("change", () => open(byKey.get(`${$("test").value} ${view.row.frame}`)));
$("mode").addEventListener("change", changeMode);
$("left").addEventListener("change", draw);
$("right").addEventListener("change", draw);
$("in").addEventListener("click", () => zoom(1.5));
$("out").addEventListener("click", () => zoom(1 / 1.5));
$("fit").addEventListener("click", () => { fit(); draw(); });
$("exposure").addEventListener("input", () => setStops(Number($("exposure").value)));
$("slider").addEventListener("input", () => setSlider($("slider").value / 1000));
$("top").addEventListener("change", () => {
  const top = Number($("top").value);
  if (top > 0 && Number.isFinite(top)) { view.top = top; showScale(); draw(); }
});
$("theme").addEventListener("click", toggleTheme);
$("keys").addEventListener("click", () => $("help").showModal());
for (const [key, what] of [...KEYS.map(([key, what]) => [key, what]), ["arrows", "move, on the picture; with shift by one pixel"],
  ["d", "light or dark"], ["Esc", "back to the summary"], ["?", "these keys"]]) {
  $("help").querySelector("dl").append(element("dt", key), element("dd", what));
}
addEventListener("resize", () => { if (view.row && !$("frame").hidden) { resize(); draw(); } });
addEventListener("hashchange", follow);

showVerdicts();
showTests();
showCourse();
showWorst();
showTable();
showRest();
follow();
