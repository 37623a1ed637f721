// The page: states are asked for once, then followed by events. Whatever is missed is asked for again.
import { TokenNeeded, ask, json, listen, save, setToken } from "./api.js";
import * as panel from "./panel.js";
import { State } from "./state.js";
import { View } from "./view.js";

const { $ } = panel;
/** Between two looks at agents and submaps that still grow. */
const POLL_MS = 2000;
const FETCHES_AT_ONCE = 3;

const state = new State();
const view = new View($("scene"), state);

/** What tests and the curious may look at. */
const coma = {
  ready: false,
  state,
  view,
  /** By submap: how often its surfels were downloaded. */
  downloads: {},
  on,
  get counts() {
    const trajectories = {};
    for (const [agent, poses] of state.poses) trajectories[agent] = poses.length;
    return {
      agents: state.agents.filter((agent) => agent.reachable).length,
      trajectories,
      maps: state.maps().length,
      submaps: state.submaps.size,
      surfels: view.surfels,
      drawnSurfels: view.drawnSurfels,
      loopsAccepted: state.graph.loops.filter((loop) => loop.counts && loop.accepted).length,
      loopsRejected: state.graph.loops.filter((loop) => loop.counts && !loop.accepted).length,
    };
  },
};
window.coma = coma;

/** Runs `work` after so many milliseconds, and not again while it is waiting or under way. */
function soon(work, after) {
  let [waiting, running, again] = [false, false, false];
  const run = async () => {
    waiting = false;
    running = true;
    try {
      await work();
    } catch (error) {
      failed(error);
    }
    running = false;
    if (again) {
      again = false;
      start();
    }
  };
  const start = () => {
    if (running) again = true;
    else if (!waiting) {
      waiting = true;
      setTimeout(run, typeof after === "function" ? after() : after);
    }
  };
  return start;
}

function failed(error) {
  if (error instanceof TokenNeeded) {
    $("token-note").textContent = error.message;
    $("token").hidden = false;
    $("token-text").focus();
  } else console.warn(error);
}

const redraw = soon(() => {
  view.place();
  panel.map(state, view);
  panel.loops(state);
  panel.hint(state);
  // A machine that draws slowly has other things to do as well.
}, () => Math.min(Math.max(120, 3 * view.frameMs), 5000));

const getAgents = soon(async () => {
  state.setAgents((await json("api/v1/agents")).agents);
  panel.agents(state, { focus: (agent) => view.focus(agent), save: saved });
  panel.hint(state);
}, 50);

const getGraph = soon(async () => {
  state.graph = await json("api/v1/graph");
  redraw();
}, 300);

const getSubmaps = soon(async () => {
  state.setSubmaps((await json("api/v1/submaps")).submaps);
  redraw();
  getSurfels();
}, 200);

const getOpenSubmaps = soon(async () => {
  state.addSubmaps((await json("api/v1/submaps?open=true")).submaps);
  redraw();
  getSurfels();
}, 50);

const getTrajectories = soon(async () => {
  state.setTrajectories((await json("api/v1/trajectories")).trajectories);
  redraw();
}, 50);

/** Surfels of submaps that are new or have grown. A submap that only moved is not among them. */
const getSurfels = soon(async () => {
  const stale = [...state.submaps.values()].filter((submap) => submap.surfels && view.revision(submap.id) !== submap.revision);
  const one = async () => {
    for (let submap = stale.pop(); submap; submap = stale.pop()) {
      try {
        const response = await ask(`api/v1/submaps/${submap.id}/surfels?revision=${submap.revision}`);
        view.setSurfels(submap, await response.arrayBuffer());
        coma.downloads[submap.id] = (coma.downloads[submap.id] ?? 0) + 1;
        redraw();
      } catch (error) {
        // An open submap may have nothing to show yet; it is asked for again when it has grown.
        if (error instanceof TokenNeeded) throw error;
      }
    }
  };
  await Promise.all(Array.from({ length: FETCHES_AT_ONCE }, one));
  coma.ready = true;
}, 50);

function everything() {
  getAgents();
  getSubmaps();
  getTrajectories();
  getGraph();
}

function on(event) {
  switch (event.type) {
    case "again": return everything();
    case "agents": return getAgents();
    case "pose":
      state.addPose(event.agent, event.pose);
      if (!state.submaps.has(event.pose.submap)) getSubmaps();
      return redraw();
    case "submap":
      state.addSubmaps([event.submap]);
      getSurfels();
      return redraw();
    case "correction":
      state.correct(event.component);
      redraw();
      // Submaps after the cut are placed by their agent, and the graph has new weights.
      getSubmaps();
      return getGraph();
    case "verdict": return getGraph();
  }
}

async function follow() {
  for (;;) {
    try {
      await listen(on, () => panel.connection("live", "live"));
    } catch (error) {
      failed(error);
      if (error instanceof TokenNeeded) return;
    }
    panel.connection("broken", "reconnecting");
    await new Promise((resolve) => setTimeout(resolve, 1000));
  }
}

async function saved(path, name) {
  await save(path, name).catch(failed);
}

let pictureUrl = null;
const render = soon(async () => {
  const width = 640;
  const { clientWidth, clientHeight } = $("scene");
  const viewpoint = view.viewpoint(width, Math.max(8, Math.round((width * clientHeight) / clientWidth)));
  if (!viewpoint) return;
  $("rendering").hidden = false;
  $("rendering-note").textContent = "rendering ...";
  const begin = performance.now();
  try {
    const body = JSON.stringify({ ...viewpoint, output: $("output").value, format: "jpeg" });
    const picture = await (await ask("api/v1/render", { method: "POST", body })).blob();
    if (pictureUrl) URL.revokeObjectURL(pictureUrl);
    pictureUrl = URL.createObjectURL(picture);
    $("picture").src = pictureUrl;
    const { width: w, height: h } = viewpoint.camera;
    $("rendering-note").textContent = `${w} x ${h}, ${Math.round(performance.now() - begin)} ms`;
  } catch (error) {
    $("rendering-note").textContent = error.message;
    if (error instanceof TokenNeeded) failed(error);
  }
}, 30);

for (const [id, kind] of [["show-surfels", "surfels"], ["show-trajectories", "trajectories"], ["show-cameras", "cameras"], ["show-accepted", "accepted"], ["show-rejected", "rejected"], ["tint", "tint"]]) {
  const box = $(id);
  const take = () => {
    view.shown[kind] = box.checked;
    view.show();
  };
  box.addEventListener("change", take);
  take();
}
const takeBudget = () => {
  view.budget = 2 ** $("budget").value;
  $("budget-text").textContent = panel.number(view.budget);
  view.draw();
};
$("budget").addEventListener("input", takeBudget);
takeBudget();
$("fit").addEventListener("click", () => view.fit());
$("save-map").addEventListener("click", () => saved("api/v1/map.ply", "map.ply"));
$("save-graph").addEventListener("click", () => saved("api/v1/graph", "graph.json"));
$("render").addEventListener("click", render);
$("output").addEventListener("change", render);
$("close-rendering").addEventListener("click", () => {
  $("rendering").hidden = true;
  $("follow").checked = false;
});
view.onMoved(() => $("follow").checked && render());
$("token").addEventListener("submit", (event) => {
  event.preventDefault();
  setToken($("token-text").value);
  $("token").hidden = true;
  follow();
});

panel.map(state, view);
setInterval(() => {
  if (document.hidden || !$("token").hidden) return;
  getAgents();
  if ([...state.submaps.values()].some((submap) => !submap.closed)) getOpenSubmaps();
}, POLL_MS);
follow();
