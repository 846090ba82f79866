// Reads the data in the page: a description in JSON, and the tracks of the Gaussians as deflated integers in base64.

async function readScene() {
  const scene = JSON.parse(document.getElementById("description").textContent);
  const bytes = await inflate(document.getElementById("data").textContent);
  const { keys, still, moving, images } = scene;
  let start = 0;

  // Undoes `pack` of exporters/tracks.py: the bytes, in planes, of the differences between instants, per channel.
  function next(Type, instants, count, channels) {
    const rows = new Type(instants * count * channels);
    for (let channel = 0; channel < channels; channel++) {
      for (let byte = 0; byte < Type.BYTES_PER_ELEMENT; byte++) {
        for (let row = 0; row < instants * count; row++) {
          rows[row * channels + channel] += bytes[start++] << (8 * byte);
        }
      }
    }
    for (let i = count * channels; i < rows.length; i++) rows[i] += rows[i - count * channels];
    return rows;
  }

  const geometry = (instants, count) => [
    next(Uint16Array, instants, count, 3),
    next(Int8Array, instants, count, 4),
    next(Uint8Array, instants, count, 4),
  ];
  const atRest = geometry(1, still);
  const inMotion = geometry(keys, moving);
  [scene.positions, scene.quats, scene.shapes] = atRest.map((rows, i) => joined(rows, inMotion[i]));
  scene.colors = images.map(() => next(Uint8Array, keys, still + moving, 3));
  return scene;
}

async function inflate(base64) {
  const text = atob(base64.trim());
  const compressed = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) compressed[i] = text.charCodeAt(i);
  const stream = new Blob([compressed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function joined(first, second) {
  const both = new first.constructor(first.length + second.length);
  both.set(first);
  both.set(second, first.length);
  return both;
}
