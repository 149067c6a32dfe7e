// The row under the bar of the optical image that plays videos, folders and the gaze path: step, play, time.

import { change, make } from "/web/page_parts.js";
import { buttonOf } from "./elements.js";

// What has a part of the row, to which its own elements belong: names of the buttons and the slider; its film, null for none now;
// words of its position, also for screen readers, and a problem instead; started() is called before it plays.
/**
 * @typedef {{ names: { back: string, play: string, pause: string, forward: string, slider: string }, part: HTMLElement,
 *   film: () => Film | null, words: () => string, problem?: () => string, started: () => void }} Player
 */

export class Transport {
  /** @type {Player[]} */ players = [];

  constructor() {
    this.root = make("div", undefined, { className: "film", id: "transport", hidden: true });
    this.back = buttonOf("◂", () => this.film?.step(-1));
    this.play = buttonOf("▶", () => this.toggle());
    this.forward = buttonOf("▸", () => this.film?.step(1));
    this.slider = make("input", undefined, { type: "range", min: "0", step: "1", value: "0" });
    this.slider.addEventListener("input", () => { this.film?.go(Number(this.slider.value), false); this.film?.pause(); });
    this.slider.addEventListener("change", () => this.film?.go(Number(this.slider.value), true));
    this.label = make("span", undefined, "quiet");
    this.root.append(this.back, this.play, this.forward, this.slider, this.label);
  }

  /** @param {Player} player */
  add(player) {
    this.players.push(player);
    player.part.hidden = true;
    this.root.append(player.part);
  }

  // The row plays the last film, unless another one is playing.
  get player() {
    const able = this.players.filter((one) => one.film());
    return able.find((one) => one.film()?.isPlaying) ?? able.at(-1) ?? null;
  }

  get film() { return this.player?.film() ?? null; }

  toggle() {
    const { player } = this, film = player?.film();
    if (film?.isPlaying) film.pause();
    else if (player && film) {
      player.started();
      film.play();
    }
  }

  // Shows the positions of films.
  show() {
    const { back, play, forward, slider, label, player, film } = this, open = this.players.filter(({ part }) => !part.hidden);
    change(this.root, { hidden: !open.length });
    if (!open.length) return;
    const { names } = player ?? open[open.length - 1], n = film?.n ?? 0, last = (film?.count ?? 1) - 1;
    const problem = open.map((one) => one.problem?.()).find(Boolean) || "";
    const words = problem || open.map((one) => one.words()).filter(Boolean).join(" · ");
    slider.max = String(last);
    if (!film || film.isPlaying || !film.isBusy) slider.value = String(n);
    const playing = film?.isPlaying ? names.pause : names.play;
    change(slider, { ariaLabel: names.slider, ariaValueText: words, disabled: last < 1 });
    change(play, { textContent: film?.isPlaying ? "❚❚" : "▶", title: playing, ariaLabel: playing, disabled: last < 1 });
    change(back, { title: names.back, ariaLabel: names.back, disabled: n <= 0 });
    change(forward, { title: names.forward, ariaLabel: names.forward, disabled: n >= last });
    for (const each of [back, play, forward, slider]) each.hidden = !film && open.every((one) => one.part.id === "film");
    change(label, { textContent: words, title: words, className: problem ? "quiet wrong" : "quiet" });
  }
}
