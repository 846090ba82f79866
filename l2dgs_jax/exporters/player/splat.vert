#version 300 es
// A Gaussian between two key instants, projected to first order around its centre (EWA), as a quad that covers it.
precision highp float;
precision highp int;
precision highp usampler2D;

uniform usampler2D positions;
uniform sampler2D quats, shapes, colors;
uniform int still, moving, key;
uniform float part;
uniform vec3 boxLow, boxSize;
uniform vec2 logScales;  // the smallest, and the difference of the largest from it
uniform float brightest;
uniform mat3 rotation;  // world to camera: x right, y down, z forward
uniform vec3 translation;
uniform vec2 focal, principal, size;  // pixels
uniform float nearPlane, minAlpha, fieldMargin, dilation;

layout(location = 0) in uint gaussian;
out vec2 offset;  // from the centre, in standard deviations
flat out vec4 tint;

ivec2 texel(int row) {
  int width = textureSize(positions, 0).x;
  return ivec2(row % width, row / width);
}

mat3 turn(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
  );
}

void main() {
  int index = int(gaussian);
  bool moves = index >= still;
  ivec2 last = texel(moves ? index + key * moving : index);
  ivec2 next = texel(moves ? index + (key + 1) * moving : index);
  vec3 place = mix(vec3(texelFetch(positions, last, 0).xyz), vec3(texelFetch(positions, next, 0).xyz), part);
  vec4 quat = normalize(mix(texelFetch(quats, last, 0), texelFetch(quats, next, 0), part));
  vec4 shape = mix(texelFetch(shapes, last, 0), texelFetch(shapes, next, 0), part);
  vec3 scales = exp(logScales.x + shape.xyz * logScales.y);
  float opacity = shape.w;
  ivec2 lastColor = texel(index + key * (still + moving)), nextColor = texel(index + (key + 1) * (still + moving));
  vec3 color = mix(texelFetch(colors, lastColor, 0).rgb, texelFetch(colors, nextColor, 0).rgb, part);
  tint = vec4(brightest * color, opacity);

  vec3 seen = rotation * (boxLow + place / 65535.0 * boxSize) + translation;
  if (seen.z <= nearPlane || opacity < minAlpha) {
    gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
    return;
  }
  vec2 direction = seen.xy / seen.z;
  vec2 margin = 0.5 * fieldMargin * size / focal;
  vec2 tangent = clamp(direction, -principal / focal - margin, (size - principal) / focal + margin);
  mat3 turned = rotation * turn(quat);
  vec3 u = focal.x / seen.z * (vec3(1.0, 0.0, -tangent.x) * turned) * scales;
  vec3 v = focal.y / seen.z * (vec3(0.0, 1.0, -tangent.y) * turned) * scales;

  // The Cholesky factor of the covariance maps a circle to the ellipse, and the square around it to the quad.
  float xx = dot(u, u), xy = dot(u, v), yy = dot(v, v);
  float determinant = max(xx * yy - xy * xy, 0.0) + dilation * (xx + yy + dilation);
  float across = sqrt(xx + dilation);
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  offset = corner * sqrt(2.0 * log(opacity / minAlpha) + 1e-3);
  vec2 pixel = principal + focal * direction;
  pixel += vec2(across * offset.x, (xy * offset.x + sqrt(determinant) * offset.y) / across);
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
}
