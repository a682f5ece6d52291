// Pictures: each lies in a script beside the page, for a page from a disk may not read the pixels of
// images.

const KEPT = 9; // decoded pictures, and layers drawn from them, that are kept
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
      let taken = false;
      waiting.take = (picture) => { taken = true; resolve(picture); };
      const script = element("script", null, { src: `${place(data.pictures)}/${place(name)}.js` });
      script.addEventListener("load", () => {
        script.remove();
        if (!taken) reject(new Error("A picture is damaged: write the report again with --resume after deleting it."));
      });
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

// Draws a picture as it is shown now: at an exposure, or under a scale of JND.
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
