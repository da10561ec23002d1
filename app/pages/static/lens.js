// The lens: its map of blur, the blur at a point, and how its error fell.

import { byId, problemText } from "./common.js";

const ASPECT = 1.5;
const ZONES = [
  ["center", "Center", []],
  ["mid", "Middle", [8, 4]],
  ["corner", "Corners", [2, 3]],
];

// Brightness as the square root of light, as the map has it: faint tails stay visible.
function draw(canvas, rows) {
  const size = rows.length;
  const peak = Math.max(...rows.flat());
  canvas.width = canvas.height = size;
  const context = canvas.getContext("2d");
  const picture = context.createImageData(size, size);
  rows.flat().forEach((value, i) => {
    picture.data.fill(Math.round(255 * Math.sqrt(Math.max(0, value) / peak)), 4 * i, 4 * i + 3);
    picture.data[4 * i + 3] = 255;
  });
  context.putImageData(picture, 0, 0);
}

// Full width at half maximum of a Gaussian of the same spread.
function widthOf(rows) {
  const half = (rows.length - 1) / 2;
  let spread = 0;
  rows.forEach((row, y) => row.forEach((value, x) => (spread += value * ((x - half) ** 2 + (y - half) ** 2))));
  return 2.355 * Math.sqrt(spread / 2);
}

function tell(list, pairs) {
  list.replaceChildren(
    ...pairs.flatMap(([name, value]) => {
      const [term, words] = [document.createElement("dt"), document.createElement("dd")];
      term.textContent = name;
      words.textContent = value;
      return [term, words];
    }),
  );
}

export function setUpField() {
  const field = byId("field");
  if (!field) return;
  const controls = byId("field-controls");
  const [map, spot] = [field.querySelector("img"), field.querySelector(".spot")];
  const lens = `/v1/lenses/${field.dataset.lens}`;
  const [columns, rows] = field.clientWidth < 500 ? [6, 4] : [9, 6];
  let [x, y] = [1 - 0.5 / columns, 0.5 / rows];
  let asked = 0;
  const settings = () => {
    const chosen = new URLSearchParams(new FormData(controls));
    if (!chosen.get("aperture")) chosen.delete("aperture");
    return chosen;
  };
  const showPoint = async () => {
    spot.style.left = `${x * 100}%`;
    spot.style.top = `${y * 100}%`;
    const [right, up] = [(2 * x - 1) * ASPECT, 1 - 2 * y];
    const r = Math.min(1, Math.hypot(right, up) / Math.hypot(ASPECT, 1));
    const query = settings();
    query.set("r", r.toFixed(4));
    query.set("phi", Math.atan2(up, right).toFixed(4));
    for (const kind of ["json", "npy", "tiff"]) byId(`psf-${kind}`).href = `${lens}/psf.${kind}?${query}`;
    asked += 1;
    const mine = asked;
    const response = await fetch(`${lens}/psf.json?${query}`);
    const failed = response.ok ? null : await problemText(response);
    const answer = response.ok ? await response.json() : null;
    if (mine !== asked) return; // the point has moved on meanwhile
    const where = r < 0.02 ? "In the center" : `${Math.round(r * 100)} % of the way to the corner`;
    if (failed) {
      byId("psf-words").textContent = failed;
      tell(byId("psf-numbers"), []);
      return;
    }
    const { psf, support } = answer;
    draw(byId("psf"), psf.data);
    const width = `${widthOf(psf.data).toFixed(1)} pixels`;
    byId("psf").setAttribute("aria-label", `Blur at the chosen point, ${width} wide`);
    byId("psf-words").textContent = support.extrapolated ? `${where}: beyond what photos showed, a guess` : where;
    const error = support.predicted_error === null ? "unknown" : `${Math.round(support.predicted_error * 100)} %`;
    tell(byId("psf-numbers"), [
      ["A point is drawn", `${width} wide`],
      ["Picture above", `${psf.data.length} pixels across`],
      ["Seen in", `${support.photos} photo${support.photos === 1 ? "" : "s"}`],
      ["Worth", `${support.effective_samples.toFixed(1)} samples`],
      ["Expected error", error],
      ...(support.family ? [["Leans on your other copies", `${Math.round(support.family.weight * 100)} %`]] : []),
    ]);
  };
  const showField = () => {
    field.classList.add("loading");
    map.src = `${lens}/field.png?grid=${columns}x${rows}&${settings()}`;
    showPoint();
  };
  for (const kind of ["load", "error"]) map.addEventListener(kind, () => field.classList.remove("loading"));
  field.addEventListener("click", (event) => {
    const box = field.getBoundingClientRect();
    [x, y] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    showPoint();
  });
  field.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!step) return;
    event.preventDefault();
    x = Math.min(1, Math.max(0, x + step[0] / (2 * columns)));
    y = Math.min(1, Math.max(0, y + step[1] / (2 * rows)));
    showPoint();
  });
  controls.addEventListener("change", showField);
  controls.addEventListener("submit", (event) => event.preventDefault());
  const seen = byId("show-coverage");
  seen.addEventListener("change", () => byId("coverage").toggleAttribute("hidden", !seen.checked));
  showField();
}

function plot(holder, events) {
  const style = getComputedStyle(document.documentElement);
  const probe = document.createElement("i");
  document.body.append(probe);
  // colours are written as light-dark(): let the browser say which one holds
  const colour = (name) => ((probe.style.color = `var(--${name})`), getComputedStyle(probe).color);
  const font = `14px ${style.fontFamily}`;
  const axis = { stroke: colour("soft"), grid: { stroke: colour("line"), width: 1 }, ticks: { show: false }, font, labelFont: font };
  const of = (event, zone) => (typeof event.error === "object" ? (event.error?.[zone] ?? null) : event.error);
  const options = {
    width: holder.clientWidth - 16,
    height: 280,
    legend: { live: false },
    scales: { x: { time: false }, y: { range: (_, __, most) => [0, Math.max(0.1, most * 1.1)] } },
    axes: [
      { ...axis, label: "version of the lens", size: 34, labelSize: 26, incrs: [1, 2, 5, 10, 20, 50] },
      { ...axis, label: "relative error", size: 60 },
    ],
    series: [
      { label: "Version" },
      ...ZONES.map(([zone, label, dash]) => ({ label, stroke: colour(zone), width: 2.5, dash, points: { show: true, size: 7, fill: colour(zone) } })),
    ],
  };
  const data = [events.map((event) => event.version), ...ZONES.map(([zone]) => events.map((event) => of(event, zone)))];
  probe.remove();
  holder.replaceChildren();
  const made = new window.uPlot(options, data, holder);
  new ResizeObserver(() => made.setSize({ width: holder.clientWidth - 16, height: 280 })).observe(holder);
  return made;
}

export async function setUpHistory() {
  const holder = byId("history");
  if (!holder) return;
  const all = [];
  for (let next = `/v1/lenses/${holder.dataset.lens}/calibrations`; next; ) {
    const response = await fetch(next);
    if (!response.ok) return;
    const page = await response.json();
    all.push(...page.items);
    next = page.next;
  }
  const known = (event) => (typeof event.error === "object" ? Object.keys(event.error ?? {}).length : true);
  const events = all.filter(known);
  if (events.length < 2) return; // one point is no curve: the page says it in words
  const made = plot(holder, events);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    made.destroy();
    plot(holder, events);
  });
}
