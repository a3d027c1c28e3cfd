// Chooses the number of layers to fetch and draw: as many as link and device sustain.

const SHARE = 0.8; // of the measured link that a group may take
const [HIGH, LOW] = [1, 0.5]; // load of the device: fewer layers above, more below
const SLOW = 3; // measurements in a row above HIGH after which a layer is dropped
const PATIENCE = 8000; // ms until it is tried again; doubled after each failed attempt

export class LayerChoice {
  reason = null; // text for the viewer: the limit on the layers; null: none
  #device = Infinity; // layers that this device draws in time
  #chosen = Infinity;
  #slow = 0;
  #wait = PATIENCE;
  #next = 0;

  // For the next group. rates: Mbit/s of its first 1, 2, .. layers; link: Mbit/s, 0 if unknown.
  choose(rates, link) {
    const fit = link ? Math.max(rates.filter((r) => r < SHARE * link).length, 1) : rates.length;
    this.#chosen = Math.min(fit, this.#device, this.#chosen + 1, rates.length);
    this.reason = this.#chosen === rates.length ? null : fit <= this.#device ? "the link carries" : "this device draws";
    return this.#chosen;
  }

  // A measurement: `load` is the share of the time that the slowest stage takes.
  look(load, count, now) {
    this.#slow = load > HIGH ? this.#slow + 1 : 0;
    const drawn = Math.min(this.#device, count);
    if (this.#slow >= SLOW && drawn > 1) {
      [this.#device, this.#slow] = [drawn - 1, 0];
      this.#next = now + this.#wait;
      this.#wait *= 2;
    } else if (load < LOW && drawn < count && now > this.#next) {
      this.#device = drawn + 1;
      this.#next = now + this.#wait;
    }
  }
}
