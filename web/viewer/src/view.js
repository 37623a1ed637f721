// What is drawn: maps side by side, and in each its submaps, trajectories, cameras and loops.
//
// A map's frame is a camera's (x right, y down, z forward); here y is up, so the root is turned half about x.
import {
  AxesHelper, Box3, BufferGeometry, Color, Float32BufferAttribute, Group, LineBasicMaterial, LineSegments, Matrix4,
  PerspectiveCamera, Quaternion, Scene, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { LineMaterial } from "three/examples/jsm/lines/LineMaterial.js";
import { LineSegments2 } from "three/examples/jsm/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/examples/jsm/lines/LineSegmentsGeometry.js";
import { discard, limit, surfelObject } from "./surfels.js";

const GROUND = "#0c0f14";
const ACCEPTED = "#4fd18b";
const DOUBTED = "#f2b84b";
const REJECTED = "#ff6b6b";
/** Between maps that are not joined, metres. */
const GAP_M = 1.5;
const FLIP = new Matrix4().makeRotationX(Math.PI);
/** From a camera as the agents have it (y down, z forward) to one as three.js has it (y up, z back). */
const CAMERA_FLIP = new Matrix4().makeScale(1, -1, -1);

export function matrix(pose) {
  const at = new Vector3(pose.tx_m, pose.ty_m, pose.tz_m);
  return new Matrix4().compose(at, new Quaternion(pose.qx, pose.qy, pose.qz, pose.qw), new Vector3(1, 1, 1));
}

export class View {
  shown = { surfels: true, trajectories: true, cameras: true, accepted: true, rejected: false, tint: false };
  budget = 2 ** 21;
  drawnSurfels = 0;
  /** What drawing took the last time, milliseconds. */
  frameMs = 0;
  #state;
  #scene = new Scene();
  #root = new Group();
  /** By map id. */
  #maps = new Map();
  /** By submap id: the object, its revision and its share. */
  #surfels = new Map();
  #lines = [];
  #wanted = false;
  #fitted = false;
  #moved = () => {};

  constructor(canvas, state) {
    this.#state = state;
    this.renderer = new WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
    this.renderer.setClearColor(GROUND);
    this.camera = new PerspectiveCamera(55, 1, 0.02, 500);
    this.camera.position.set(2, 3, 6);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.zoomToCursor = true;
    this.controls.addEventListener("start", () => (this.#fitted = true));
    this.controls.addEventListener("change", () => this.draw());
    this.controls.addEventListener("end", () => this.#moved());
    this.#root.matrixAutoUpdate = false;
    this.#root.matrix.copy(FLIP);
    this.#scene.add(this.#root);
    new ResizeObserver(() => this.#resize()).observe(canvas);
    this.#resize();
  }

  /** Calls back when the viewer has moved. */
  onMoved(moved) {
    this.#moved = moved;
  }

  /** Draws once, at the next frame. */
  draw() {
    if (this.#wanted) return;
    this.#wanted = true;
    requestAnimationFrame(() => {
      this.#wanted = false;
      this.#share();
      const begin = performance.now();
      this.renderer.render(this.#scene, this.camera);
      requestAnimationFrame(() => (this.frameMs = performance.now() - begin));
    });
  }

  /** Puts a submap's surfels on the graphics card, in place of an earlier revision. */
  setSurfels(submap, buffer) {
    const object = surfelObject(buffer, this.#state.color(submap.agent));
    const before = this.#surfels.get(submap.id);
    if (before) discard(before.object);
    this.#surfels.set(submap.id, { object, revision: submap.revision });
    this.place();
  }

  /** The revision of a submap's surfels that is here. */
  revision(id) {
    return this.#surfels.get(id)?.revision;
  }

  /** Where a submap's surfels are drawn, in their map. */
  surfelMatrix(id) {
    return this.#surfels.get(id)?.object.matrix;
  }

  /** A submap's first surfel as the graphics card has it: centre, rotation x y z w, scales, colour and opacity. */
  firstSurfel(id) {
    const { geometry } = this.#surfels.get(id).object;
    const columns = { center: 3, rotation: 4, scale: 2, surfelColor: 4 };
    const read = (name) => Array.from({ length: columns[name] }, (_, k) => geometry.getAttribute(name).getComponent(0, k));
    return { center: read("center"), rotation: read("rotation"), scale: read("scale"), color: read("surfelColor") };
  }

  get surfels() {
    return [...this.#surfels.values()].reduce((sum, { object }) => sum + object.userData.surfels, 0);
  }

  /** Puts everything where the state says. Surfels move by their submap's matrix. */
  place() {
    const state = this.#state;
    for (const [id, { object }] of this.#surfels) {
      if (state.submaps.has(id)) continue;
      discard(object);
      this.#surfels.delete(id);
    }
    for (const line of this.#lines) {
      line.geometry.dispose();
      line.material.dispose();
      line.removeFromParent();
    }
    this.#lines = [];
    const maps = state.maps();
    for (const [id, group] of this.#maps) {
      if (maps.some((map) => map.id === id)) continue;
      group.removeFromParent();
      this.#maps.delete(id);
    }
    let right = null;
    for (const map of maps) {
      if (!this.#maps.has(map.id)) {
        const group = new Group();
        group.add(new AxesHelper(0.3));
        this.#maps.set(map.id, group);
        this.#root.add(group);
      }
      const group = this.#maps.get(map.id);
      const extent = new Box3();
      for (const submap of map.submaps) {
        const map_from_submap = matrix(submap.map_from_submap);
        extent.expandByPoint(new Vector3().setFromMatrixPosition(map_from_submap));
        const surfels = this.#surfels.get(submap.id)?.object;
        if (!surfels) continue;
        surfels.matrix.copy(map_from_submap);
        surfels.matrixWorldNeedsUpdate = true;
        group.add(surfels);
        const { center, radius } = surfels.geometry.boundingSphere;
        const around = center.clone().applyMatrix4(map_from_submap);
        extent.expandByPoint(around.clone().addScalar(radius)).expandByPoint(around.addScalar(-radius));
      }
      // The first map stands at the origin, others to its right until they are joined with it.
      group.position.x = right === null ? 0 : right - extent.min.x + GAP_M;
      right = group.position.x + extent.max.x;
      group.updateMatrixWorld(true);
    }
    this.#trajectories(maps);
    this.#loops();
    this.show();
    if (!this.#fitted && maps.length) this.fit();
  }

  /** Shows what is switched on. */
  show() {
    for (const { object } of this.#surfels.values()) {
      object.visible = this.shown.surfels;
      object.material.uniforms.tinted.value = this.shown.tint ? 0.75 : 0;
    }
    for (const line of this.#lines) line.visible = this.shown[line.userData.kind];
    this.draw();
  }

  /** Brings everything into view, a few far strays aside. */
  fit() {
    const [points, cameras] = [[], new Box3()];
    for (const map of this.#state.maps()) {
      const group = this.#maps.get(map.id);
      for (const submap of map.submaps) {
        cameras.expandByPoint(new Vector3().setFromMatrixPosition(this.#world(group, submap)));
        const object = this.#surfels.get(submap.id)?.object;
        if (object) points.push(...sample(object));
      }
    }
    if (cameras.isEmpty()) return;
    const box = cameras.clone();
    for (const axis of points.length ? ["x", "y", "z"] : []) {
      const sorted = points.map((point) => point[axis]).sort((a, b) => a - b);
      const stray = Math.floor(0.02 * sorted.length);
      box.min[axis] = Math.min(box.min[axis], sorted[stray]);
      box.max[axis] = Math.max(box.max[axis], sorted[sorted.length - 1 - stray]);
    }
    const center = box.getCenter(new Vector3());
    const radius = Math.max(box.getSize(new Vector3()).length() / 2, 0.8);
    const away = (0.85 * radius) / Math.sin((this.camera.fov * Math.PI) / 360);
    this.controls.target.copy(center);
    this.camera.position.copy(center).add(new Vector3(-0.35, 0.6, 1).setLength(away));
    this.controls.update();
    this.draw();
  }

  /** Goes to an agent's camera. */
  focus(agent) {
    const at = this.#last.get(agent);
    if (!at) return;
    this.#fitted = true;
    const position = new Vector3().setFromMatrixPosition(at);
    const offset = this.camera.position.clone().sub(this.controls.target).setLength(3);
    this.controls.target.copy(position);
    this.camera.position.copy(position).add(offset);
    this.controls.update();
    this.draw();
  }

  /** The present viewpoint in the largest map, as the gateway takes it. */
  viewpoint(width, height) {
    const map = this.#state.maps()[0];
    if (!map) return null;
    this.camera.updateMatrixWorld();
    const map_from_world = this.#maps.get(map.id).matrixWorld.clone().invert();
    const map_from_camera = map_from_world.multiply(this.camera.matrixWorld).multiply(CAMERA_FLIP);
    const [at, q, scale] = [new Vector3(), new Quaternion(), new Vector3()];
    map_from_camera.decompose(at, q, scale);
    const f = height / 2 / Math.tan((this.camera.fov * Math.PI) / 360);
    return {
      map: map.id,
      map_from_camera: { tx_m: at.x, ty_m: at.y, tz_m: at.z, qx: q.x, qy: q.y, qz: q.z, qw: q.w },
      camera: { width, height, fx: f, fy: f, cx: (width - 1) / 2, cy: (height - 1) / 2 },
    };
  }

  /** By agent: where its camera is now, in the world. */
  #last = new Map();

  #world(group, submap) {
    return group.matrixWorld.clone().multiply(matrix(submap.map_from_submap));
  }

  /** Where a submap lies in the world, or nothing. */
  #worldOf(id) {
    const submap = this.#state.submaps.get(id);
    const group = submap && this.#maps.get(submap.map);
    return group ? this.#world(group, submap) : null;
  }

  #trajectories() {
    this.#last.clear();
    for (const [agent, poses] of this.#state.poses) {
      const color = this.#state.color(agent);
      const [path, anchors] = [[], []];
      let before = null;
      const world = new Map();
      for (const pose of poses) {
        if (pose.state === "lost") {
          before = null;
          continue;
        }
        const first = !world.has(pose.submap);
        if (first) world.set(pose.submap, this.#worldOf(pose.submap));
        const submap = world.get(pose.submap);
        if (!submap) continue;
        const camera = submap.clone().multiply(matrix(pose.submap_from_camera));
        const at = new Vector3().setFromMatrixPosition(camera);
        const map = this.#state.submaps.get(pose.submap).map;
        if (before?.map === map) path.push(before.at.x, before.at.y, before.at.z, at.x, at.y, at.z);
        if (first) frustum(camera, 0.07, anchors);
        before = { at, map };
        this.#last.set(agent, camera);
      }
      if (path.length) this.#add(fat(path, color, 2.5), "trajectories");
      if (anchors.length) this.#add(thin(anchors, color, 0.6), "cameras");
      const now = [];
      if (this.#last.has(agent)) frustum(this.#last.get(agent), 0.22, now);
      if (now.length) this.#add(fat(now, color, 2.5), "cameras");
    }
  }

  #loops() {
    const [accepted, doubted, rejected] = [[], [], []];
    for (const loop of this.#state.graph.loops) {
      if (!loop.counts) continue;
      const [from, to] = [this.#worldOf(loop.from), this.#worldOf(loop.to)];
      if (!from || !to) continue;
      const [a, b] = [new Vector3().setFromMatrixPosition(from), new Vector3().setFromMatrixPosition(to)];
      const outlier = loop.solution && loop.solution.weight < 0.5;
      (loop.accepted ? (outlier ? doubted : accepted) : rejected).push(a.x, a.y, a.z, b.x, b.y, b.z);
    }
    if (rejected.length) this.#add(thin(rejected, REJECTED, 0.45), "rejected");
    if (doubted.length) this.#add(fat(doubted, DOUBTED, 1.5), "accepted");
    if (accepted.length) this.#add(fat(accepted, ACCEPTED, 1.8), "accepted");
  }

  #add(line, kind) {
    line.userData.kind = kind;
    line.frustumCulled = false;
    this.#lines.push(line);
    this.#scene.add(line);
  }

  /** Shares the budget among submaps. */
  #share() {
    const all = this.surfels;
    const share = all > this.budget ? this.budget / all : 1;
    this.drawnSurfels = 0;
    for (const { object } of this.#surfels.values()) {
      limit(object, share);
      if (object.visible) this.drawnSurfels += object.geometry.instanceCount;
    }
  }

  #resize() {
    const canvas = this.renderer.domElement;
    const [width, height] = [canvas.clientWidth || 1, canvas.clientHeight || 1];
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    // The panel covers the right side: the middle of the view is the middle of what is left.
    const panel = width > 760 ? 320 : 0;
    this.camera.setViewOffset(width, height, panel / 2, 0, width, height);
    this.camera.updateProjectionMatrix();
    this.draw();
  }
}

/** Some of an object's centres in the world. */
function sample(object) {
  const { array, count } = object.geometry.getAttribute("center");
  object.updateWorldMatrix(true, false);
  const some = Math.min(count, 500);
  return Array.from({ length: some }, (_, i) => new Vector3().fromArray(array, 3 * i).applyMatrix4(object.matrixWorld));
}

/** A camera's pyramid as line segments. */
function frustum(world_from_camera, depth, out) {
  const [x, y] = [0.6 * depth, 0.45 * depth];
  const tip = new Vector3().applyMatrix4(world_from_camera);
  const corners = [[-x, -y], [x, -y], [x, y], [-x, y]].map(([u, v]) => new Vector3(u, v, depth).applyMatrix4(world_from_camera));
  corners.forEach((corner, i) => {
    out.push(...tip.toArray(), ...corner.toArray());
    out.push(...corner.toArray(), ...corners[(i + 1) % 4].toArray());
  });
}

function fat(positions, color, width) {
  const geometry = new LineSegmentsGeometry().setPositions(positions);
  return new LineSegments2(geometry, new LineMaterial({ color: new Color(color), linewidth: width }));
}

function thin(positions, color, opacity) {
  const geometry = new BufferGeometry().setAttribute("position", new Float32BufferAttribute(positions, 3));
  return new LineSegments(geometry, new LineBasicMaterial({ color: new Color(color), opacity, transparent: true }));
}
