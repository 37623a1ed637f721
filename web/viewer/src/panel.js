// The side panel. Everything that comes from agents is set as text, never as markup.

const $ = (id) => document.getElementById(id);

function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

export function number(n) {
  if (n >= 1e9) return `${(n / 1e9).toFixed(2)} G`;
  if (n >= 1e6) return `${(n / 1e6).toFixed(2)} M`;
  if (n >= 1e4) return `${(n / 1e3).toFixed(1)} k`;
  return `${n}`;
}

function bytes(n) {
  if (n >= 2 ** 30) return `${(n / 2 ** 30).toFixed(2)} GiB`;
  if (n >= 2 ** 20) return `${(n / 2 ** 20).toFixed(1)} MiB`;
  if (n >= 2 ** 10) return `${(n / 2 ** 10).toFixed(0)} KiB`;
  return `${n} B`;
}

export function connection(kind, text) {
  $("connection").className = `chip ${kind}`;
  $("connection").textContent = text;
}

/** What each agent is doing. */
export function agents(state, { focus, save }) {
  const cards = state.agents.map((agent) => {
    const { status } = agent;
    const name = agent.id ?? agent.endpoint;
    const title = element("button", { textContent: name, title: "Go to its camera" });
    title.addEventListener("click", () => agent.id && focus(agent.id));
    // An agent that has no frames yet has nothing to track.
    const stateName = !agent.reachable ? "unreachable" : status?.frames_processed ? status.state : "waiting";
    const card = element("li", { className: "agent" }, element("div", { className: "name" }, title, element("span", { className: `chip ${stateName}`, textContent: stateName })));
    card.style.setProperty("--color", agent.id ? state.color(agent.id) : "var(--quiet)");
    if (status) {
      const between = status.bytes_sent.filter((b) => b.class === "peer" || b.class === "gossip").reduce((sum, b) => sum + b.bytes, 0);
      const alive = status.peers.filter((peer) => peer.alive).length;
      const generation = status.generation;
      const figures = [
        ["frames", number(status.frames_processed), status.frames_dropped ? `${status.frames_dropped} more were dropped` : ""],
        ["submaps", number(status.submaps), ""],
        ["surfels", number(status.surfels), `${status.surfels}`],
        ["to peers", bytes(between), "Bytes that it sent to other agents"],
        ["peers", `${alive} of ${status.peers.length}`, status.peers.map((p) => `${p.id ?? p.endpoint}: ${p.alive ? "answers" : p.error}`).join("\n")],
        ["generation", generation ? generation.digest.slice(0, 8) : "none", generation ? `Map ${generation.map}, from ${Object.values(generation.cut).reduce((a, b) => a + b, 0)} entries` : "No result of the graph places it yet"],
      ];
      card.append(element("dl", {}, ...figures.map(([what, value, title]) => element("div", { title }, element("dt", { textContent: what }), element("dd", { textContent: value })))));
      for (const warning of status.warnings) card.append(element("p", { className: "note", textContent: warning }));
      if (agent.reachable) {
        const tum = element("button", { textContent: "trajectory.tum" });
        tum.addEventListener("click", () => save(`api/v1/agents/${agent.id}/trajectory.tum`, `${agent.id}.tum`));
        card.append(element("div", { className: "links" }, tum));
      }
    }
    if (agent.error) card.append(element("p", { className: "note bad", textContent: agent.error }));
    return card;
  });
  $("agents").replaceChildren(...cards);
}

/** What the agents have made of it together. */
export function map(state, view) {
  const maps = state.maps();
  $("map-summary").textContent = mapText(state, maps);
  $("total-surfels").textContent = number([...state.submaps.values()].reduce((sum, s) => sum + s.surfels, 0));
  $("total-surfels").title = `${number(view.surfels)} are here, ${number(view.drawnSurfels)} are drawn`;
  $("total-submaps").textContent = number(state.submaps.size);
  $("total-frames").textContent = number([...state.poses.values()].reduce((sum, poses) => sum + poses.length, 0));
  for (const id of ["save-map", "save-graph", "fit", "render"]) $(id).disabled = !maps.length;
}

function mapText(state, maps) {
  if (!maps.length) return "No map yet.";
  const names = (agents) => [...agents].sort().join(", ");
  if (maps.length === 1) {
    return maps[0].agents.size > 1 ? `One map, agreed by ${names(maps[0].agents)}.` : `One map, by ${names(maps[0].agents)}.`;
  }
  const why = state.graph.not_joined.map((n) => `${n.agent_a} and ${n.agent_b}: ${n.message}.`).join(" ");
  return `${maps.length} maps that are not joined yet, side by side. ${why}`;
}

/** Loops by verdict, with the reasons of those that were rejected. */
export function loops(state) {
  const counted = state.graph.loops.filter((loop) => loop.counts);
  const accepted = counted.filter((loop) => loop.accepted).length;
  $("loop-summary").textContent = counted.length ? `${accepted} accepted, ${counted.length - accepted} rejected.` : "No places were compared yet.";
  const reasons = new Map();
  for (const loop of counted) {
    if (loop.accepted) continue;
    const known = reasons.get(loop.reason) ?? { count: 0, message: loop.message };
    known.count++;
    reasons.set(loop.reason, known);
  }
  const items = [...reasons].sort((a, b) => b[1].count - a[1].count).slice(0, 8).map(([reason, { count, message }]) =>
    element("li", { title: message }, element("span", { textContent: reason.replaceAll("_", " ") }), element("span", { textContent: `${count}` })));
  $("reasons").replaceChildren(...items);
}

/** What to do while there is nothing to see. */
export function hint(state) {
  const box = $("hint").firstElementChild;
  const show = (title, ...lines) => {
    box.replaceChildren(element("h2", { textContent: title }), ...lines.map((line) => element(line.startsWith("$ ") ? "code" : "p", { textContent: line.replace(/^\$ /, "") })));
    $("hint").hidden = false;
  };
  const reachable = state.agents.filter((agent) => agent.reachable);
  if (!state.knowsSubmaps) return;
  if (state.submaps.size) $("hint").hidden = true;
  else if (!state.agents.length) {
    show("No agents are known", "Name them when the gateway starts:", "$ coma gateway --agent http://robot-1:7001", "Or see the whole cluster on a built-in world:", "$ coma demo");
  } else if (!reachable.length) {
    show("No agent answers", "They are asked again every second. The panel says what went wrong with each.");
  } else {
    show("The agents wait for frames", "Stream a recording to one of them, and its map grows here:", `$ coma stream SPEC --to ${reachable[0].endpoint}`);
  }
}

export { $ };
