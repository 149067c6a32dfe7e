// Buttons and slider of a film, for rows under the bar of a view.

import { make } from "/web/page_parts.js";

/** @typedef {{ back: string, play: string, pause: string, forward: string, slider: string }} FilmNames */

/** @type {(text: string, title: string, act: () => void) => HTMLButtonElement} */
export function rowButton(text, title, act) {
  const button = make("button", text);
  Object.assign(button, { type: "button", title });
  button.setAttribute("aria-label", title || text);
  button.addEventListener("click", act);
  return button;
}

export class FilmRow {
  // film() returns the present film; started() is called before it plays.
  /** @param {FilmNames} names @param {() => Film | null} film @param {() => void} started */
  constructor(names, film, started) {
    this.names = names;
    this.film = film;
    this.started = started;
    this.back = rowButton("◂", names.back, () => this.film()?.step(-1));
    this.play = rowButton("▶", names.play, () => this.toggle());
    this.forward = rowButton("▸", names.forward, () => this.film()?.step(1));
    this.slider = make("input");
    Object.assign(this.slider, { type: "range", min: 0, step: 1, value: 0 });
    this.slider.setAttribute("aria-label", names.slider);
    this.slider.addEventListener("input", () => { this.film()?.go(Number(this.slider.value), false); this.film()?.pause(); });
    this.slider.addEventListener("change", () => this.film()?.go(Number(this.slider.value), true));
  }

  get elements() { return [this.back, this.play, this.forward, this.slider]; }

  toggle() {
    const film = this.film();
    if (film?.isPlaying) film.pause();
    else if (film) {
      this.started();
      film.play();
    }
  }

  // Shows the position of a film, with its words for screen readers.
  /** @param {Film | null} film @param {string} words */
  show(film, words) {
    const { back, play, forward, slider, names } = this, n = film?.n ?? 0, last = (film?.count ?? 1) - 1;
    slider.max = String(last);
    if (!film || film.isPlaying || !film.isBusy) slider.value = String(n);
    slider.setAttribute("aria-valuetext", words);
    slider.disabled = last < 1;
    play.textContent = film?.isPlaying ? "❚❚" : "▶";
    play.title = film?.isPlaying ? names.pause : names.play;
    play.setAttribute("aria-label", play.title);
    play.disabled = last < 1;
    back.disabled = n <= 0;
    forward.disabled = n >= last;
  }
}
