#version 300 es
// Composites the blended Gaussians over the background.
precision highp float;

uniform sampler2D blended;
uniform float background;
out vec4 color;

void main() {
  vec4 value = texelFetch(blended, ivec2(gl_FragCoord.xy), 0);
  color = vec4(value.rgb + background * (1.0 - value.a), 1.0);
}
