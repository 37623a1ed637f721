// Surfels as oriented discs. A submap's surfels stay on the graphics card in the submap's own frame; where the
// submap lies is its object's matrix, so a correction of the map moves it and sends nothing.
import {
  BufferAttribute, Color, InstancedBufferAttribute, InstancedBufferGeometry, Mesh,
  ShaderMaterial, Sphere, Vector3,
} from "three";
import { unpack } from "./pack.js";

// A disc is drawn to this many standard deviations, and where it is at least so opaque.
const EXTENT = 2.0;
const ALPHA_MIN = 0.2;
// A disc's rim is drawn so many standard deviations farther away than its middle: where discs overlap, each shows
// around its own middle.
const CONE = 1.0;

const vertexShader = /* glsl */ `
in vec3 center;
in vec4 rotation;
in vec2 scale;
in vec4 surfelColor;
out vec2 onDisc;
out vec4 shade;

vec3 rotated(vec3 v, vec4 q) { return v + 2.0 * cross(q.xyz, cross(q.xyz, v) + q.w * v); }

void main() {
  onDisc = position.xy * ${EXTENT.toFixed(1)};
  vec3 inSubmap = center + rotated(vec3(onDisc * scale, 0.0), normalize(rotation));
  shade = surfelColor;
  vec3 seen = (modelViewMatrix * vec4(inSubmap, 1.0)).xyz;
  // Along the line of sight: the picture of the disc stays the same.
  seen *= 1.0 + position.z * ${CONE.toFixed(1)} * max(scale.x, scale.y) / max(length(seen), 1e-3);
  gl_Position = projectionMatrix * vec4(seen, 1.0);
}`;

const fragmentShader = /* glsl */ `
uniform vec3 tint;
uniform float tinted;
in vec2 onDisc;
in vec4 shade;
out vec4 pixel;

void main() {
  if (shade.a * exp(-0.5 * dot(onDisc, onDisc)) < ${ALPHA_MIN.toFixed(2)}) discard;
  float light = dot(shade.rgb, vec3(0.299, 0.587, 0.114));
  pixel = vec4(mix(shade.rgb, tint * (0.25 + 0.75 * light), tinted), 1.0);
}`;

/** Four corners, z = 1, around a middle, z = 0. */
const corners = new BufferAttribute(new Float32Array([-1, -1, 1, 1, -1, 1, 1, 1, 1, -1, 1, 1, 0, 0, 0]), 3);
const sides = new BufferAttribute(new Uint16Array([0, 1, 4, 1, 2, 4, 2, 3, 4, 3, 0, 4]), 1);

/** One submap's surfels as an object; its matrix is set by whoever knows where the submap lies. */
export function surfelObject(buffer, agentColor) {
  const { count, center, rotation, scale, color } = unpack(buffer);
  const geometry = new InstancedBufferGeometry();
  geometry.setAttribute("position", corners);
  geometry.setIndex(sides);
  geometry.setAttribute("center", new InstancedBufferAttribute(center, 3));
  geometry.setAttribute("rotation", new InstancedBufferAttribute(rotation, 4, true));
  geometry.setAttribute("scale", new InstancedBufferAttribute(scale, 2));
  geometry.setAttribute("surfelColor", new InstancedBufferAttribute(color, 4, true));
  geometry.instanceCount = count;
  geometry.boundingSphere = bounds(center);
  const material = new ShaderMaterial({
    vertexShader,
    fragmentShader,
    uniforms: { tint: { value: new Color(agentColor) }, tinted: { value: 0 } },
    glslVersion: "300 es",
  });
  const object = new Mesh(geometry, material);
  object.userData.surfels = count;
  object.matrixAutoUpdate = false;
  return object;
}

/** Draws at most so many of a submap's surfels: an even sample. */
export function limit(object, share) {
  object.geometry.instanceCount = Math.ceil(object.userData.surfels * share);
}

/** A sphere around all but far strays. */
function bounds(center) {
  const middle = new Vector3();
  const count = center.length / 3;
  for (let i = 0; i < center.length; i += 3) middle.add(new Vector3(center[i], center[i + 1], center[i + 2]));
  if (count) middle.divideScalar(count);
  let radius = 0;
  for (let i = 0; i < center.length; i += 3) {
    radius = Math.max(radius, Math.hypot(center[i] - middle.x, center[i + 1] - middle.y, center[i + 2] - middle.z));
  }
  return new Sphere(middle, radius + 0.1);
}

/** Frees what the graphics card holds. */
export function discard(object) {
  // Corners and sides are shared; three.js sends them again if they are still needed.
  object.geometry.dispose();
  object.material.dispose();
  object.removeFromParent();
}

