// Frames of a camera of this computer.

import { context2d } from "/web/gl.js";

// Longer sides of frames, pixels, and largest number of pixels: three bytes each, below the limit of a message.
export const SIZES = [240, 320, 480, 640];
const MAX_PIXELS = 327680;
export const FIRST_SIZE = 480;
/** @type {{ [name: string]: string }} */
const PROBLEMS = {
  NotAllowedError: "The browser does not permit the camera for this page",
  NotFoundError: "There is no camera",
  NotReadableError: "The camera is in use by another program",
  OverconstrainedError: "There is no suitable camera",
};

export class Camera {
  /** @type {MediaStream | null} */ stream = null;
  /** @type {HTMLVideoElement | null} */ video = null;

  constructor() { this.size = FIRST_SIZE; this.canvas = document.createElement("canvas"); }

  // Starts; returns null, or the reason in one line. ended() is called when the camera is disconnected.
  /** @type {(ended: () => void) => Promise<string | null>} */
  async start(ended) {
    if (!navigator.mediaDevices?.getUserMedia) return "Browsers permit cameras only at 127.0.0.1 or with https";
    try {
      this.stream = await navigator.mediaDevices.getUserMedia({ video: { width: { ideal: 640 }, height: { ideal: 480 } }, audio: false });
      this.video = Object.assign(document.createElement("video"), { muted: true, playsInline: true, srcObject: this.stream });
      await this.video.play();
    } catch (/** @type {any} */ error) {
      this.stop();
      return PROBLEMS[error.name] || "The camera does not start (" + error.name + ")";
    }
    for (const track of this.stream.getTracks()) track.addEventListener("ended", ended);
    return null;
  }

  stop() {
    for (const track of this.stream?.getTracks() || []) track.stop();
    if (this.video) this.video.srcObject = null;
    this.stream = this.video = null;
  }

  get isOn() { return Boolean(this.stream); }

  // Returns the present frame: { width, height, pixels: RGB, top row first }; null when the camera is off.
  frame() {
    const { video } = this;
    if (!video) return null;
    const { videoWidth, videoHeight } = video;
    const scale = Math.min(1, this.size / Math.max(videoWidth, videoHeight), Math.sqrt(MAX_PIXELS / (videoWidth * videoHeight)));
    const width = Math.max(1, Math.round(scale * videoWidth)), height = Math.max(1, Math.round(scale * videoHeight)), { canvas } = this;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const context = context2d(canvas, { willReadFrequently: true, alpha: false });
    context.drawImage(video, 0, 0, width, height);
    const { data } = context.getImageData(0, 0, width, height), pixels = new Uint8Array(3 * width * height);
    for (let i = 0, k = 0; k < pixels.length; i += 4) {
      pixels[k++] = data[i];
      pixels[k++] = data[i + 1];
      pixels[k++] = data[i + 2];
    }
    return { width, height, pixels };
  }
}
