"use strict";
// What the page knows. Foreign text (names, notes) goes into the page as text only, never as markup.

const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const rows = data.rows.map((row, number) => ({
  number, frame: row[0], test: row[1], values: row[2], width: row[3][0], height: row[3][1],
  peak: row[4], counts: row[5], regions: row[6], pictures: row[7], block: row[8], notes: row[9],
}));
const column = Object.fromEntries(data.figures.map((figure, number) => [figure.name, number]));
const maximum = (row) => row.values[column.max_jnd];
const testName = (row) => data.tests[row.test];
const byKey = new Map(rows.map((row) => [`${row.test} ${row.frame}`, row]));

// The frame of a row, and a region of it, are an address of the page.
const address = (row, at) => `#${row.number}${at ? `/${at.slice(0, 4).join(",")}` : ""}`;
function open(row, at) { location.hash = address(row, at); }

const place = (path) => path.split("/").map(encodeURIComponent).join("/");
const short = (text) => (text.length > 28 ? `…${text.slice(-27)}` : text);
const plural = (count, what) => `${count} ${what}${count === 1 ? "" : "s"}`;

function shown(figure, value) {
  if (value === null || value === undefined) return "–";
  const number = figure.percent ? value * 100 : value;
  const text = number.toFixed(figure.digits).replace(/^-(0\.?0*)$/, "$1");
  const sign = figure.name === "mean_luminance_change" && Number(text) > 0 ? "+" : "";
  return sign + text + (figure.percent ? " %" : "");
}

function element(tag, text, attributes) {
  const made = document.createElement(tag);
  if (text !== undefined && text !== null) made.textContent = text;
  for (const [name, value] of Object.entries(attributes || {})) made.setAttribute(name, value);
  return made;
}

// A plot with its two axes; `x` and `y` are d3's axes.
const MARGIN = { left: 40, right: 8, top: 8, bottom: 34 };
function plot(width, height, label, x, y) {
  const svg = d3.create("svg").attr("viewBox", [0, 0, width, height]).attr("role", "img").attr("aria-label", label);
  const grid = y.tickSize(MARGIN.left + MARGIN.right - width).tickSizeOuter(0).tickPadding(5);
  svg.append("g").attr("class", "grid").attr("transform", `translate(${MARGIN.left},0)`).call(grid);
  svg.append("g").attr("class", "below").attr("transform", `translate(0,${height - MARGIN.bottom})`)
    .call(x.tickSize(3).tickSizeOuter(0));
  return svg;
}
const across = (width) => [MARGIN.left, width - MARGIN.right];
const upwards = (height) => [height - MARGIN.bottom, MARGIN.top];
