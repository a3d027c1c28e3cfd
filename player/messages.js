// Messages to the viewer beside the image: notes in the corner, failures, the busy sign, the time bar, statistics.
//
// In: the state of the player and of its engine. Out: text and colours of the controls.

import { clock, setIcon } from "./controls.js";
import { AUTO } from "./native.js";

const STALL = 300; // ms without an image until the busy sign appears

export function sentence(text) {
  const s = text.charAt(0).toUpperCase() + text.slice(1);
  return /[.!?]$/.test(s) ? s : `${s}.`;
}

export class Messages {
  #times = []; // of the images of the last second
  #busySince = 0;
  #told = 0; // time at which the text was last set
  #colors; // of the time bar
  #slow = 0; // how often in a row too few images were drawn
  #frame = 0;
  #changed = -Infinity; // time at which the frame last changed

  constructor(player) {
    this.player = player;
  }

  // Images of the last second.
  get drawn() {
    return this.#times.length;
  }

  pictured(now) {
    this.#times.push(now);
    this.#busySince = 0;
  }

  // The busy sign; `ready`: whether there is an image to draw.
  wait(now, ready) {
    if (ready) this.#busySince = 0;
    else this.#busySince ||= now;
    this.player.$(".busy").hidden = !this.#busySince || now - this.#busySince < STALL;
  }

  // Updates the time, the time bar, the statistics and the notes on slow playback.
  follow(now) {
    const { player } = this;
    while (this.#times.length && this.#times[0] < now - 1000) this.#times.shift();
    const bar = player.$(".seek input");
    if (!bar.matches(":active")) bar.value = player.frame;
    setIcon(player.$("[data-do=play]"), player.paused ? "play" : "pause");
    if (now - this.#told < 100) return;
    this.#told = now;
    const seconds = (n) => clock(n / player.fps);
    player.$(".time").innerHTML = `${seconds(player.frame)} <small>/ ${seconds(player.frameCount)}</small>`;
    bar.setAttribute("aria-valuetext", `frame ${player.frame} of ${player.frameCount}`);
    this.#paint();
    this.#tellSlow(now);
    if (!player.$(".stats").hidden) player.$(".stats").textContent = this.#figures();
  }

  // Colours the time bar: fetched, not fetched, damaged.
  #paint() {
    const { player } = this;
    const { source, failed } = player.engine;
    const at = (t) => `${((100 * t) / Math.max(player.frameCount, 1)).toFixed(2)}%`;
    const parts = source.groups.map((g, i) => {
      const color = failed.has(i) ? "#a4503f" : source.has(i) ? "#8a909c" : "#4a4d55";
      return `${color} ${at(g.start_frame)} ${at(g.start_frame + g.frames)}`;
    });
    const track = parts.length ? `linear-gradient(90deg, ${parts.join()})` : "";
    if (track !== this.#colors) player.$(".seek").style.setProperty("--track", track);
    this.#colors = track;
  }

  #tellSlow(now) {
    const { player } = this;
    if (player.frame !== this.#frame) [this.#frame, this.#changed] = [player.frame, now];
    const wanted = Math.min(player.fps * player.speed, 60);
    const drawn = this.#times.length;
    const due = !player.paused && now - this.#changed < 1000; // not for one frame, or at the end of a growing file
    this.#slow = !due || drawn > 0.8 * wanted || !player.$(".busy").hidden ? 0 : this.#slow + 1;
    const text = `This device draws ${drawn} of ${Math.round(wanted)} frames a second.`;
    this.note("slow", this.#slow > 20 ? text : null);
    const { source, layers, choice, groups } = player.engine;
    const shown = groups.get(player.engine.groupOf(player.frame));
    const fewer = layers === AUTO && choice.reason && shown?.layers < shown?.header?.layers;
    this.note("layers", fewer ? `${shown.layers} of ${shown.header.layers} layers: ${choice.reason} no more just now.` : null);
    this.note("quality", source.limited ? `Quality ${source.quality}: the link or this device carries no more just now.` : null);
  }

  #figures() {
    const { player } = this;
    const { source } = player.engine;
    const [s, [width, height]] = [player.stats, player.shown?.view ?? [0, 0]];
    const group = source.groups[player.engine.groupOf(player.frame)];
    const rate = group ? (8e-6 * group.size * player.fps) / group.frames : 0;
    return [
      ["fps", `${s.fps} of ${player.fps.toFixed(1)}`],
      ["frame", `${player.frame} of ${player.frameCount}`],
      ["picture", `${width} x ${height}`],
      ["drawn by", player.engine.renderer.name],
      ["Gaussians", s.gaussians.toLocaleString("en")],
      ["decode", `${s.decode.toFixed(1)} ms/frame`],
      ["project", `${s.project.toFixed(1)} ms`],
      ["blend", `${s.blend.toFixed(1)} ms`],
      ["stream", `${rate.toFixed(2)} Mbit/s`],
      ["link", s.link ? `${s.link.toFixed(1)} Mbit/s` : "–"],
      ...(source.quality ? [["quality", source.quality]] : []),
      ["received", `${(s.received / 1e6).toFixed(2)} MB`],
    ].map(([name, value]) => `${name.padEnd(10)}${value}`).join("\n");
  }

  // A line in the corner; null removes it.
  note(id, text, warn = false) {
    const notes = this.player.$(".notes");
    let note = notes.querySelector(`[data-id="${id}"]`);
    if (!text) return note?.remove();
    if (!note) {
      note = document.createElement("div");
      note.dataset.id = id;
      notes.append(note);
    }
    note.className = warn ? "note warn" : "note";
    if (note.textContent !== text) note.textContent = text;
  }

  damaged({ group, frames, message }) {
    this.note("damage", `Frames ${frames} are damaged and left out (group ${group}: ${message}).`, true);
  }

  missed({ frames, message }) {
    this.note("link", null);
    this.note("fetch", `Frames ${frames} cannot be fetched: ${sentence(message)} Trying again…`, true);
  }

  // The player stops; the first failure stays.
  fail(title, message) {
    const { player } = this;
    if (!player.$(".error").hidden) return;
    player.pause();
    player.$(".busy").hidden = true;
    player.$(".notes").replaceChildren();
    player.$(".error h2").textContent = title;
    player.$(".error p").textContent = message;
    player.$(".error").hidden = false;
    player.dispatchEvent(new CustomEvent("error", { detail: `${title}: ${message}` }));
  }
}
