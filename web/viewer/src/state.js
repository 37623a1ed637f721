// What is known of the agents: replaced whole when states are asked for again, and added to by events.

/** Colours of agents, far apart on a dark ground. */
const COLORS = ["#5cc8ff", "#ffb454", "#b98cff", "#57e39b", "#ff7eb6", "#f4e04d", "#4de0d8", "#ff8a65"];

export class State {
  agents = [];
  /** By submap id. */
  submaps = new Map();
  /** False until the submaps were asked for once: until then it isn't known whether there are any. */
  knowsSubmaps = false;
  /** By agent: poses by sequence. */
  poses = new Map();
  graph = { loops: [], components: [], not_joined: [], submaps: [], odometry: [] };
  #colors = new Map();

  /** An agent keeps its colour for as long as the page is open. */
  color(agent) {
    if (!this.#colors.has(agent)) this.#colors.set(agent, COLORS[this.#colors.size % COLORS.length]);
    return this.#colors.get(agent);
  }

  setAgents(agents) {
    this.agents = agents;
    // In the order of names, as far as they are known.
    for (const agent of agents) if (agent.id) this.color(agent.id);
  }

  setSubmaps(submaps) {
    this.submaps = new Map(submaps.map((submap) => [submap.id, submap]));
    this.knowsSubmaps = true;
  }

  /** Submaps that were asked for alone: others stay as they are. An answer that is older than the list of all has no say. */
  addSubmaps(submaps) {
    for (const submap of submaps) {
      const isOlder = this.submaps.get(submap.id)?.closed && !submap.closed;
      if (!isOlder) this.submaps.set(submap.id, submap);
    }
  }

  setTrajectories(trajectories) {
    this.poses = new Map();
    for (const { agent, poses } of trajectories) for (const pose of poses) this.addPose(agent, pose);
  }

  addPose(agent, pose) {
    if (!this.poses.has(agent)) this.poses.set(agent, []);
    const poses = this.poses.get(agent);
    // Sequences begin anew with every session; stamps and submaps tell those apart.
    const last = poses.at(-1);
    if (last && last.submap === pose.submap && last.sequence >= pose.sequence) {
      const known = poses.findLastIndex((p) => p.submap === pose.submap && p.sequence === pose.sequence);
      if (known >= 0) {
        poses[known] = pose;
        return;
      }
    }
    poses.push(pose);
  }

  correct(component) {
    for (const { id, map_from_submap } of component.submaps) {
      const submap = this.submaps.get(id);
      if (submap) Object.assign(submap, { map_from_submap, map: component.generation.map });
    }
  }

  /** Maps with their submaps, the one with most surfels first. */
  maps() {
    const maps = new Map();
    for (const submap of this.submaps.values()) {
      if (!maps.has(submap.map)) maps.set(submap.map, { id: submap.map, submaps: [], surfels: 0, agents: new Set() });
      const map = maps.get(submap.map);
      map.submaps.push(submap);
      map.surfels += submap.surfels;
      map.agents.add(submap.agent);
    }
    return [...maps.values()].sort((a, b) => b.surfels - a.surfels || a.id.localeCompare(b.id));
  }
}
