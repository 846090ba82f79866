// The page: what the canvas shows, playback, and the buttons.

const LARGEST_CUT = 2; // a side of the picture over the part of it that stays visible if the canvas has another shape
const MOST_PIXELS = 2; // largest number of canvas pixels per CSS pixel
const element = (id) => document.getElementById(id);

class Player {
  constructor(scene, canvas) {
    Object.assign(this, { scene, canvas, time: 0, playing: false, looping: true, image: 0, scheduled: false });
    this.renderer = createRenderer(canvas, scene);
    this.resize();
    this.reset();

    this.sorter = new Worker(URL.createObjectURL(new Blob([element("sorter").textContent])));
    const { positions, still, moving } = scene;
    this.sorter.postMessage({ positions, still, moving });
    this.sorting = false;
    this.unsorted = true;
    this.sorter.onmessage = ({ data }) => {
      this.sorting = false;
      this.sorted = data;
      this.renderer.arrange(data);
      this.schedule();
    };

    new ResizeObserver(() => this.resize()).observe(canvas);
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      this.renderer = createRenderer(canvas, scene);
      if (this.sorted) this.renderer.arrange(this.sorted);
      this.resize();
    });
    steer(
      canvas,
      () => this.view,
      () => (this.lens().focal[0] * canvas.clientWidth) / canvas.width,
      () => {
        this.following = false;
        this.changed();
      },
    );
  }

  // The lens of the camera that the view started from, enlarged until the picture fills the canvas, but no further than
  // LARGEST_CUT allows.
  lens() {
    const { width, height, dilation } = this.scene;
    const size = [this.canvas.width, this.canvas.height];
    const fits = [size[0] / width, size[1] / height];
    const scale = Math.min(Math.max(...fits), LARGEST_CUT * Math.min(...fits));
    const { focal, principal } = this.camera;
    return {
      focal: focal.map((pixels) => scale * pixels),
      principal: [width, height].map((side, i) => size[i] / 2 + scale * (principal[i] - side / 2)),
      dilation: dilation * Math.max(scale ** 2, 1), // trained with a blur in pixels of the training views
    };
  }

  reset() {
    this.following = this.scene.path;
    this.stand();
    this.changed();
  }

  // Move to the camera that filmed this instant.
  stand() {
    this.camera = cameraAt(this.scene, this.time);
    this.view = new View(this.camera, this.scene.up);
  }

  resize() {
    const pixels = Math.min(devicePixelRatio, MOST_PIXELS);
    const sides = [this.canvas.clientWidth, this.canvas.clientHeight];
    this.renderer.resize(...sides.map((side) => Math.max(Math.round(pixels * side), 1)));
    this.schedule();
  }

  changed() {
    this.unsorted = true;
    this.schedule();
  }

  seek(time) {
    this.time = Math.min(Math.max(time, 0), 1);
    if (this.following) this.stand();
    this.changed();
    this.onseek?.();
  }

  play(playing) {
    if (playing && this.time === 1) this.time = 0;
    this.playing = playing;
    this.before = undefined;
    this.schedule();
    this.onplay?.();
  }

  show(image) {
    this.image = image;
    this.schedule();
  }

  schedule() {
    this.canvas.ariaBusy = "true";
    if (this.scheduled) return;
    this.scheduled = true;
    requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.scheduled = false;
    if (this.playing) this.advance(now);
    const keys = this.scene.keys - 1;
    const key = Math.min(Math.floor(this.time * keys), keys - 1);
    const instant = { key, part: this.time * keys - key };
    if (this.unsorted && !this.sorting) this.sort(instant);
    if (!this.sorted) return;
    this.renderer.draw(this.view, this.lens(), instant, this.image);
    this.ondraw?.();
    if (!this.scheduled && !this.sorting) this.canvas.ariaBusy = "false";
  }

  advance(now) {
    const time = this.time + (now - (this.before ?? now)) / 1000 / this.scene.seconds;
    this.before = now;
    this.seek(this.looping ? time % 1 : time);
    if (!this.looping && time >= 1) this.play(false);
  }

  sort({ key, part }) {
    const { box, nearPlane } = this.scene;
    const axis = this.view.axes[2];
    const row = axis.map((value, i) => (value * (box[1][i] - box[0][i])) / 65535);
    const offset = dot(axis, box[0]) + this.view.translation[2];
    this.sorting = true;
    this.unsorted = false;
    this.sorter.postMessage({ key, part, row, offset, nearPlane });
  }
}

function connect(player) {
  const { scene } = player;
  const [time, play, loop, dark] = ["time", "play", "loop", "dark"].map(element);
  const toggle = (button) => button.setAttribute("aria-pressed", button.getAttribute("aria-pressed") !== "true");
  const pressed = (button) => button.getAttribute("aria-pressed") === "true";
  const seconds = (part) => `${(part * scene.seconds).toFixed(1)} s`;

  player.onseek = () => {
    time.value = player.time;
    time.setAttribute("aria-valuetext", seconds(player.time));
    element("clock").textContent = `${seconds(player.time)} of ${seconds(1)}`;
  };
  player.onplay = () => {
    play.textContent = player.playing ? "Pause" : "Play";
  };
  time.addEventListener("input", () => {
    player.play(false);
    player.seek(time.valueAsNumber);
  });
  play.addEventListener("click", () => player.play(!player.playing));
  loop.addEventListener("click", () => {
    toggle(loop);
    player.looping = pressed(loop);
  });
  dark.addEventListener("click", () => {
    toggle(dark);
    player.show(pressed(dark) ? 1 : 0);
  });
  element("reset").addEventListener("click", () => player.reset());
  element("about").addEventListener("click", () => element("information").showModal());

  const step = (keys) => {
    player.play(false);
    player.seek(player.time + keys / (scene.keys - 1));
  };
  const actions = {
    " ": () => play.click(),
    l: () => dark.click(),
    r: () => player.reset(),
    ",": () => step(-1),
    ".": () => step(1),
  };
  document.addEventListener("keydown", (event) => {
    const busy = event.ctrlKey || event.metaKey || event.altKey || element("information").open;
    const action = actions[event.key.toLowerCase()];
    if (busy || !action || (event.key === " " && event.target instanceof HTMLButtonElement)) return;
    event.preventDefault();
    action();
  });
}

try {
  const player = new Player(await readScene(), element("view"));
  connect(player);
  player.ondraw = () => {
    element("notice").textContent = "";
    element("controls").hidden = false;
    player.ondraw = undefined;
  };
  player.seek(0);
  player.play(!matchMedia("(prefers-reduced-motion: reduce)").matches);
} catch (error) {
  element("notice").textContent = error.message;
}
