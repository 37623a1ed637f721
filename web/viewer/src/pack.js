// Packed surfels, as crates/surfel/src/pack.rs writes them, made into the columns that the shader reads.

const HEADER = 40;
const SURFEL = 23;
const CENTER_STEPS = 2 ** 24 - 1;
const ROTATION_HALF = 16383;
const LOG_RANGE = Math.log(1e8);

/**
 * Centres (f32 x 3), rotations x y z w (i16 x 4, normalised), scales (f32 x 2), colour and opacity (u8 x 4).
 * Surfels are shuffled in a fixed way, so that the first n of them are an even sample of all.
 */
export function unpack(buffer) {
  const view = new DataView(buffer);
  const count = buffer.byteLength >= HEADER ? view.getUint32(4, true) : 0;
  if (buffer.byteLength < HEADER || view.getUint32(0) !== 0x53464c31 || buffer.byteLength !== HEADER + count * SURFEL) {
    throw new Error("these bytes are no packed surfels");
  }
  const bytes = new Uint8Array(buffer);
  const low = [0, 1, 2].map((axis) => view.getFloat32(12 + 4 * axis, true));
  const step = [0, 1, 2].map((axis) => (view.getFloat32(24 + 4 * axis, true) - low[axis]) / CENTER_STEPS);
  const center = new Float32Array(3 * count);
  const rotation = new Int16Array(4 * count);
  const scale = new Float32Array(2 * count);
  const color = new Uint8Array(4 * count);
  const q = [0, 0, 0, 0];
  const stride = coprime(count);
  for (let i = 0, from = 0; i < count; i++, from = (from + stride) % count) {
    const at = HEADER + from * SURFEL;
    for (let axis = 0; axis < 3; axis++) {
      const code = bytes[at + 3 * axis] | (bytes[at + 3 * axis + 1] << 8) | (bytes[at + 3 * axis + 2] << 16);
      center[3 * i + axis] = low[axis] + step[axis] * code;
    }
    const codes = [view.getUint16(at + 9, true), view.getUint16(at + 11, true), view.getUint16(at + 13, true)];
    const largest = (codes[0] >> 15) | ((codes[1] >> 15) << 1);
    let rest = 1;
    for (let k = 0, next = 0; k < 4; k++) {
      if (k === largest) continue;
      const value = ((codes[next++] & 0x7fff) - ROTATION_HALF) / (ROTATION_HALF * Math.SQRT2);
      q[k] = value;
      rest -= value * value;
    }
    q[largest] = Math.sqrt(Math.max(rest, 0));
    rotation[4 * i] = q[1] * 32767;
    rotation[4 * i + 1] = q[2] * 32767;
    rotation[4 * i + 2] = q[3] * 32767;
    rotation[4 * i + 3] = q[0] * 32767;
    scale[2 * i] = 1e-6 * Math.exp((view.getUint16(at + 15, true) / 65535) * LOG_RANGE);
    scale[2 * i + 1] = 1e-6 * Math.exp((view.getUint16(at + 17, true) / 65535) * LOG_RANGE);
    color.set(bytes.subarray(at + 20, at + 23), 4 * i);
    color[4 * i + 3] = bytes[at + 19];
  }
  return { count, center, rotation, scale, color };
}

/** A stride near the golden section that visits every index once. */
function coprime(count) {
  const gcd = (a, b) => (b ? gcd(b, a % b) : a);
  let stride = Math.max(1, Math.round(count * 0.6180339887));
  while (count > 1 && gcd(stride, count) !== 1) stride++;
  return stride;
}
