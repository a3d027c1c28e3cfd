// The controls around the image; fingers, mouse and keys. Independent of streams.

const ICONS = {
  play: "M8 5v14l11-7z",
  pause: "M6 5h4v14H6zM14 5h4v14h-4z",
  back: "M18 6v12l-8.5-6zM6 6h2v12H6z",
  next: "M6 6v12l8.5-6zM16 6h2v12h-2z",
  loop: "M7 7h10v3l4-4-4-4v3H5v6h2zm10 10H7v-3l-4 4 4 4v-3h12v-6h-2z",
  reset: "M12 5V1L7 6l5 5V7a5 5 0 1 1-5 5H5a7 7 0 1 0 7-7z",
  stats: "M4 20h3V10H4zm6.5 0h3V4h-3zM17 20h3v-7h-3z",
  vr: "M3 7h18v10h-6l-2-3h-2l-2 3H3zm4.5 3a2 2 0 1 0 0 4 2 2 0 0 0 0-4zm9 0a2 2 0 1 0 0 4 2 2 0 0 0 0-4z",
  ar: "M12 2l8.7 5v10L12 22l-8.7-5V7zm0 2.3L6.7 7.4 12 10.4l5.3-3zM5.3 9v6.8l5.7 3.3v-6.8zm13.4 0L13 12.3v6.8l5.7-3.3z",
  full: "M5 5h5v2H7v3H5zm9 0h5v5h-2V7h-3zM5 14h2v3h3v2H5zm12 0h2v5h-5v-2h3z",
};

const icon = (name) => `<svg viewBox="0 0 24 24" aria-hidden="true"><path d="${ICONS[name]}"/></svg>`;
const button = (name, title, extra = "") => `<button data-do="${name}" title="${title}" aria-label="${title}" ${extra}>${icon(name)}</button>`;
const options = (list) => list.map(([value, text]) => `<option value="${value}">${text}</option>`).join("");

export const MARKUP = `
<div class="frame">
  <div class="stage" tabindex="0" role="application" aria-label="Volumetric video: drag to turn, two fingers or right button to move, wheel or pinch to zoom">
    <div class="view"><canvas></canvas></div>
    <pre class="stats" hidden></pre>
    <div class="notes" role="status"></div>
    <div class="tracks" role="group" aria-label="Tracks" hidden></div>
    <div class="busy" hidden></div>
    <div class="error" role="alert" hidden><div><h2></h2><p></p><button data-do="retry">Try again</button></div></div>
  </div>
  <div class="bar">
    <label class="seek"><input type="range" min="0" max="0" value="0" step="1" aria-label="Frame" /></label>
    ${button("play", "Play or pause (space)")}
    ${button("back", "One frame back (left arrow)", 'class="wide"')}
    ${button("next", "One frame on (right arrow)", 'class="wide"')}
    <span class="time">0:00.00</span>
    <span class="gap"></span>
    <select data-set="view" title="Camera" aria-label="Camera" hidden></select>
    <select data-set="speed" title="Speed" aria-label="Speed">${options([0.25, 0.5, 1, 2].map((v) => [v, `${v}×`]))}</select>
    <select data-set="layers" title="Layers" aria-label="Layers" hidden></select>
    <select data-set="quality" title="Quality" aria-label="Quality">${options([["auto", "Auto quality"], [1, "Full"], [0.7, "70 %"], [0.5, "50 %"], [0.35, "35 %"]])}</select>
    <select data-set="renderer" title="Drawn by" aria-label="Drawn by">${options([["auto", "CPU or GPU"], ["cpu", "CPU"], ["gpu", "GPU"]])}</select>
    ${button("loop", "Loop (L)", 'aria-pressed="false"')}
    ${button("reset", "Reset the camera (R)")}
    ${button("stats", "Statistics (S)", 'aria-pressed="false"')}
    ${button("vr", "Virtual reality", "hidden")}
    ${button("ar", "Augmented reality: tap the floor to move the scene", "hidden")}
    ${button("full", "Full screen (F)")}
  </div>
</div>`;

export function setIcon(element, name) {
  if (element.dataset.icon !== name) element.innerHTML = icon(name);
  element.dataset.icon = name;
}

export const clock = (seconds) => `${Math.floor(seconds / 60)}:${(seconds % 60).toFixed(2).padStart(5, "0")}`;

const KEYS = {
  " ": "play", k: "play", l: "loop", r: "reset", s: "stats", f: "full",
  arrowleft: "back", arrowright: "next", home: "first", end: "last", "+": "closer", "=": "closer", "-": "farther",
};

// Keys of the whole player; calls act(name, event).
export function onKeys(host, act) {
  host.addEventListener("keydown", (e) => {
    const name = KEYS[e.key.toLowerCase()];
    const inside = e.composedPath()[0];
    if (!name || e.ctrlKey || e.metaKey || e.altKey || inside.localName === "select") return;
    if (e.key === " " && inside.matches("button, [type=checkbox]")) return; // its own key
    if (/^(Arrow|Home|End)/.test(e.key) && inside.matches(".sound input")) return; // the volume's own keys
    e.preventDefault();
    act(name, e);
  });
}

// Drags and wheel on the image; calls orbit(dx, dy), pan(dx, dy) in shares of the shorter side, zoom(factor).
export function onDrag(view, { orbit, pan, zoom }) {
  const fingers = new Map();
  const unit = () => Math.max(Math.min(view.clientWidth, view.clientHeight), 1);
  view.addEventListener("pointerdown", (e) => {
    view.setPointerCapture(e.pointerId);
    fingers.set(e.pointerId, e);
    view.classList.add("dragging");
  });
  view.addEventListener("pointermove", (e) => {
    const before = fingers.get(e.pointerId);
    if (!before) return;
    const [dx, dy] = [(e.clientX - before.clientX) / unit(), (e.clientY - before.clientY) / unit()];
    if (fingers.size === 2) {
      const other = [...fingers.values()].find((f) => f.pointerId !== e.pointerId);
      const span = (f) => Math.hypot(f.clientX - other.clientX, f.clientY - other.clientY);
      if (span(before) > 5) zoom(span(e) / span(before));
      pan(dx / 2, dy / 2);
    } else if (e.buttons & 6 || e.shiftKey) pan(dx, dy);
    else orbit(dx, dy);
    fingers.set(e.pointerId, e);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    view.addEventListener(name, (e) => {
      fingers.delete(e.pointerId);
      if (!fingers.size) view.classList.remove("dragging");
    });
  }
  view.addEventListener("contextmenu", (e) => e.preventDefault());
  view.addEventListener("wheel", (e) => {
    e.preventDefault();
    zoom(Math.exp(-e.deltaY * (e.deltaMode ? 0.05 : 0.0015)));
  }, { passive: false });
}
