#version 300 es
precision highp float;

uniform float minAlpha, maxAlpha;
in vec2 offset;
flat in vec4 tint;
out vec4 premultiplied;

void main() {
  float alpha = tint.a * exp(-0.5 * dot(offset, offset));
  if (alpha < minAlpha) discard;
  alpha = min(alpha, maxAlpha);
  premultiplied = vec4(alpha * tint.rgb, alpha);
}
