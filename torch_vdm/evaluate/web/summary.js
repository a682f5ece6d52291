// The summary: what is said of the tests, plots, the worst regions, and the table of all frames.

const COLOURS = ["#2f7ed8", "#d9822b", "#2a9d5c", "#b0479e", "#8a6d3b", "#d1495b", "#00838f", "#6a5acd"];
const DASHES = ["", "6 3", "2 3"], STROKES = ["solid", "dashed", "dotted"];
const PAGE = 200; // rows of the table that are shown at once

function showVerdicts() {
  const skipped = data.skipped.length ? `, ${data.skipped.length} skipped` : "";
  $("verdicts").append(element("p",
    `${plural(data.tests.length, "test")}, ${plural(rows.length, "comparison")}${skipped}.`, { class: "lead" }));
  if (data.fail_above !== null) {
    const over = rows.filter((row) => maximum(row) > data.fail_above);
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
  add("worst max", "The largest difference in any frame, JND", (some) => d3.max(some, maximum).toFixed(2));
  data.figures.forEach((figure, number) => add(figure.label, figure.help,
    (some) => shown(figure, d3.median(some, (row) => row.values[number]))));
}

function showCourse() {
  if (!rows.length) return;
  const frames = [...new Set(rows.map((row) => row.frame))];
  const width = Math.max(300, $("course").clientWidth), height = Math.min(300, 150 + width / 4);
  const top = d3.max([1.2, ...rows.map(maximum)]);
  const x = d3.scalePoint(frames, across(width)), y = d3.scaleLinear([0, top], upwards(height));
  const ends = frames.length > 1 ? [frames[0], frames[frames.length - 1]] : frames;
  const svg = plot(width, height, `Largest difference of ${plural(frames.length, "frame")}, up to ${top.toFixed(2)} JND`,
    d3.axisBottom(x).tickValues(ends).tickFormat(short), d3.axisLeft(y).ticks(4));
  if (ends.length > 1) {
    svg.selectAll(".below .tick text").attr("text-anchor", (_, number) => (number ? "end" : "start"));
  }
  svg.append("line").attr("class", "one").attr("x1", MARGIN.left).attr("x2", width - MARGIN.right).attr("y1", y(1)).attr("y2", y(1));
  const right = (row) => x(row.frame), down = (row) => y(maximum(row));
  data.tests.forEach((test, number) => {
    const own = rows.filter((row) => row.test === number);
    const colour = COLOURS[number % COLOURS.length];
    svg.append("path").attr("d", d3.line(right, down)(own)).attr("fill", "none").attr("stroke", colour)
      .attr("stroke-width", 1.6).attr("stroke-dasharray", DASHES[number % DASHES.length]);
    if (own.length <= 60) {
      svg.append("g").attr("fill", colour).selectAll("circle").data(own).join("circle")
        .attr("cx", right).attr("cy", down).attr("r", 2.5);
    }
    const entry = element("span");
    entry.append(element("i", null, { style: `border-top:3px ${STROKES[number % STROKES.length]} ${colour}` }), test);
    $("legend").append(entry);
  });
  svg.style("cursor", "pointer").on("click", (event) => {
    const [at, jnd] = d3.pointer(event);
    open(d3.least(rows, (row) => Math.hypot(right(row) - at, (down(row) - jnd) / 4)));
  });
  $("course").append(svg.node());
}

function showWorst() {
  const all = rows.flatMap((row) => row.regions.map((region) => ({ row, region })));
  all.sort((a, b) => d3.descending(a.region[4], b.region[4]));
  for (const { row, region } of all.slice(0, 20)) {
    const link = element("a", null, { href: address(row, region) });
    const box = element("span", null, { class: "picture" });
    const inner = element("span", null, { style: `aspect-ratio:${row.width}/${row.height}` });
    inner.append(element("img", null, {
      loading: "lazy", decoding: "async", src: `${place(data.maps)}/${place(testName(row))}/${place(row.frame)}.png`,
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
const order = { by: column.max_jnd, descending: true, shown: PAGE, rows };

function sortValue(row) {
  if (order.by === "frame") return row.number;
  if (order.by === "test") return row.test;
  return row.values[order.by];
}

function arrange() {
  const wanted = $("filter").value.toLowerCase();
  const found = rows.filter((row) => `${row.frame} ${testName(row)}`.toLowerCase().includes(wanted));
  const compare = order.descending ? d3.descending : d3.ascending; // what has no value comes last
  order.rows = d3.sort(found, (a, b) => compare(sortValue(a), sortValue(b)) || missing(a) - missing(b) || a.number - b.number);
  fillTable();
}

const missing = (row) => Number(sortValue(row) === null);

function fillTable() {
  d3.select($("frames").tBodies[0]).selectAll("tr").data(order.rows.slice(0, order.shown), (row) => row.number)
    .join((entering) => entering.append(tableRow)).order();
  $("found").textContent = `${order.rows.length} of ${rows.length}`;
  $("more").hidden = order.shown >= order.rows.length;
  for (const head of $("frames").tHead.rows[0].cells) {
    const here = head.dataset.by === String(order.by);
    head.setAttribute("aria-sort", here ? (order.descending ? "descending" : "ascending") : "none");
  }
}

function tableRow(row) {
  const line = element("tr");
  line.insertCell().append(element("a", row.frame, { href: address(row) }));
  line.append(element("td", testName(row), { class: "text" }));
  data.figures.forEach((figure, number) => {
    const over = figure.name === "max_jnd" && data.fail_above !== null && row.values[number] > data.fail_above;
    line.append(element("td", shown(figure, row.values[number]), over ? { class: "bad" } : {}));
  });
  line.addEventListener("click", (event) => {
    if (!event.target.closest("a")) open(row);
  });
  return line;
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
