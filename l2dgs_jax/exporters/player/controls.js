// Controls of the camera: mouse and touch on the canvas, and keys unless another control has the focus.

const RADIANS = 1.5; // angle that a drag as long as the shorter side of the canvas turns the view by
const KEY_STEP = 0.06; // drag that an arrow key stands for, relative to the shorter side of the canvas
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

// `getView` returns the view to change, `getFocal` its focal length in CSS pixels; `changed` is called after a change.
function steer(canvas, getView, getFocal, changed) {
  const pointers = new Map();
  const shorter = () => Math.min(canvas.clientWidth, canvas.clientHeight);
  const turn = (x, y) => getView().turn((x * RADIANS) / shorter(), (y * RADIANS) / shorter());
  const move = (x, y) => getView().move(x / getFocal(), y / getFocal());

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  }
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const [x, y] = [event.clientX - before.clientX, event.clientY - before.clientY];
    const other = [...pointers.values()].find((pointer) => pointer.pointerId !== event.pointerId);
    if (other) {
      const [apart, closer] = [event, before].map((p) => Math.hypot(p.clientX - other.clientX, p.clientY - other.clientY));
      getView().approach(apart / Math.max(closer, 1));
      move(x / 2, y / 2);
    } else if (event.shiftKey || event.buttons !== 1) {
      move(x, y);
    } else {
      turn(x, y);
    }
    pointers.set(event.pointerId, event);
    changed();
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      const pixels = event.deltaMode ? 30 * event.deltaY : event.deltaY;
      getView().approach(Math.exp(-0.0015 * pixels));
      changed();
    },
    { passive: false },
  );
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (![canvas, document.body].includes(event.target)) return;
    const arrow = ARROWS[event.key];
    if (arrow) {
      const [x, y] = arrow.map((direction) => direction * KEY_STEP * shorter());
      (event.shiftKey ? move : turn)(x, y);
    } else if (event.key === "+" || event.key === "=") {
      getView().approach(1.1);
    } else if (event.key === "-") {
      getView().approach(1 / 1.1);
    } else {
      return;
    }
    event.preventDefault();
    changed();
  });
}
