// A worker that sorts the Gaussians in front of the camera, farthest first.
//
// It receives { positions, still, moving } once, and { key, part, row, offset, nearPlane } for every sort: the depth of
// a Gaussian is the dot product of `row` and its quantised position, plus `offset`.

let scene;

onmessage = ({ data }) => {
  if (data.positions) {
    scene = data;
    return;
  }
  const order = farthestFirst(depths(data), data.nearPlane);
  postMessage(order, [order.buffer]);
};

function depths({ key, part, row, offset }) {
  const { positions, still, moving } = scene;
  const result = new Float32Array(still + moving);
  const depth = (at) => row[0] * positions[at] + row[1] * positions[at + 1] + row[2] * positions[at + 2] + offset;
  for (let i = 0; i < still; i++) result[i] = depth(3 * i);
  for (let i = still; i < still + moving; i++) {
    const last = 3 * (i + key * moving);
    result[i] = (1 - part) * depth(last) + part * depth(last + 3 * moving);
  }
  return result;
}

// A radix sort of 16 bits at a time, which is exact because positive floats are ordered like their bits.
function farthestFirst(depths, nearPlane) {
  const bits = new Uint32Array(depths.buffer);
  const visible = new Uint32Array(depths.length);
  let count = 0;
  for (let i = 0; i < depths.length; i++) if (depths[i] > nearPlane) visible[count++] = i;
  let order = visible.subarray(0, count);
  for (const shift of [0, 16]) {
    const starts = new Uint32Array(65537);
    for (const i of order) starts[65536 - ((bits[i] >>> shift) & 65535)]++;
    for (let digit = 1; digit < 65537; digit++) starts[digit] += starts[digit - 1];
    const sorted = new Uint32Array(count);
    for (const i of order) sorted[starts[65535 - ((bits[i] >>> shift) & 65535)]++] = i;
    order = sorted;
  }
  return order;
}
