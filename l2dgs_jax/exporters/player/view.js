// A camera that turns around a point. Axes are those of OpenCV: x to the right, y down, z forward.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const along = (point, direction, length) => point.map((value, i) => value + length * direction[i]);
const unit = (a) => a.map((value) => value / Math.hypot(...a));

const STEEPEST = 0.98; // largest cosine between the viewing direction and the vertical
const NEAREST = 0.02; // least distance from the point that the camera turns around, relative to the initial one

function rotated(vector, axis, angle) {
  const aside = cross(axis, vector);
  const [cosine, sine, up] = [Math.cos(angle), Math.sin(angle), dot(axis, vector) * (1 - Math.cos(angle))];
  return vector.map((value, i) => value * cosine + aside[i] * sine + axis[i] * up);
}

// The camera that filmed an instant, interpolated between two training cameras; the nearest one if they form no path.
function cameraAt({ cameras, path }, time) {
  const next = cameras.findIndex((camera) => camera.time >= time);
  if (next < 1) return cameras.at(next);
  const [before, after] = [cameras[next - 1], cameras[next]];
  const part = (time - before.time) / (after.time - before.time);
  if (!path) return part < 0.5 ? before : after;
  const between = (a, b) => (Array.isArray(a) ? a.map((value, i) => between(value, b[i])) : a + part * (b - a));
  return Object.fromEntries(Object.keys(before).map((name) => [name, between(before[name], after[name])]));
}

class View {
  // The camera turns around the point that lies `distance` in front of it.
  constructor({ axes, centre, distance }, up) {
    const forward = unit(axes[2]);
    const right = unit(cross(axes[1], forward));
    this.axes = [right, cross(forward, right), forward];
    this.up = up;
    this.distance = distance;
    this.nearest = NEAREST * distance;
    this.target = along(centre, forward, distance);
  }

  get translation() {
    const centre = along(this.target, this.axes[2], -this.distance);
    return this.axes.map((axis) => -dot(axis, centre));
  }

  // Turn the scene, as if dragged by hand, to the right and downwards by these angles in radians.
  turn(right, down) {
    const yawed = this.axes.map((axis) => rotated(axis, this.up, -right));
    const turned = yawed.map((axis) => rotated(axis, yawed[0], -down));
    const [before, after] = [this.axes, turned].map((axes) => Math.abs(dot(axes[2], this.up)));
    this.axes = after < Math.max(STEEPEST, before) ? turned : yawed;
  }

  // Move the scene, as if dragged by hand, to the right and downwards by these fractions of the distance.
  move(right, down) {
    this.target = along(this.target, this.axes[0], -right * this.distance);
    this.target = along(this.target, this.axes[1], -down * this.distance);
  }

  approach(factor) {
    this.distance = Math.max(this.distance / factor, this.nearest);
  }
}
