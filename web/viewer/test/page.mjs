// Opens the page in Chromium, waits until it shows what it should, looks at it, and prints what it saw as JSON.
//
//   node test/page.mjs URL PICTURE.png FRAMES
//
// FRAMES: so many poses of each of two agents are waited for. Chromium is found as `chromium`, or where CHROMIUM says.
import puppeteer from "puppeteer-core";
import { execFileSync } from "node:child_process";

const [url, picture, frames] = process.argv.slice(2);
const executablePath = process.env.CHROMIUM ?? execFileSync("sh", ["-c", "command -v chromium || command -v google-chrome"]).toString().trim();
const browser = await puppeteer.launch({
  executablePath,
  headless: true,
  // A machine that is busy with other things is slow, not broken.
  protocolTimeout: 900_000,
  args: ["--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"],
});
// An agent that is away for a moment (502, 503, 504) is the page's daily bread, and so are a software renderer's words.
const errors = [];
try {
  const page = await browser.newPage();
  await page.setViewport({ width: 1280, height: 800 });
  page.on("pageerror", (error) => errors.push(`${error}`));
  page.on("console", (message) => ["error", "warning"].includes(message.type()) && !/GPU stall|GL Driver|status of 50[234]/.test(message.text()) && errors.push(message.text()));
  await page.goto(url, { waitUntil: "domcontentloaded" });

  // Nothing was streamed yet: the page says what to do.
  await page.waitForFunction(() => !document.getElementById("hint").hidden, { timeout: 120_000 });
  const hint = await page.$eval("#hint h2", (title) => title.textContent);
  await page.screenshot({ path: picture.replace(/\.png$/, "-empty.png") });
  console.error("the page is open");

  const complete = (frames) => {
    const { counts, ready, state, view } = window.coma;
    const trajectories = Object.values(counts.trajectories);
    const submaps = [...state.submaps.values()];
    return ready && counts.agents === 2 && counts.maps === 1 && counts.loopsAccepted > 0 && trajectories.length === 2 &&
      trajectories.every((poses) => poses >= frames) && submaps.every((submap) => submap.closed && view.revision(submap.id) === submap.revision);
  };
  await page.waitForFunction(complete, { timeout: 600_000, polling: 500 }, Number(frames));
  await page.evaluate(() => window.coma.view.fit());
  const settled = () => page.evaluate(() => new Promise((done) => setTimeout(() => requestAnimationFrame(() => requestAnimationFrame(done)), 300)));
  await settled();
  await page.click("#render");
  await page.waitForFunction(() => document.getElementById("picture").complete && document.getElementById("picture").naturalWidth > 0, { timeout: 300_000 });
  await settled();
  await page.$eval("#panel", (panel) => panel.scrollTo(0, 0));
  await page.screenshot({ path: picture });

  // What is on the canvas, by what is switched on: pixels near each agent's colour, and all that is not the ground.
  const pixels = () => page.evaluate(() => {
    const { state, view } = window.coma;
    const gl = view.renderer.getContext();
    const [width, height] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
    const data = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
    const agents = Object.fromEntries(state.agents.map(({ id }) => [id, state.color(id).match(/\w\w/g).map((c) => parseInt(c, 16))]));
    const found = { drawn: 0, agents: Object.fromEntries(Object.keys(agents).map((id) => [id, 0])) };
    for (let i = 0; i < data.length; i += 4) {
      const near = (color, by) => color.every((c, k) => Math.abs(c - data[i + k]) <= by);
      if (!near([12, 15, 20], 3)) found.drawn++;
      for (const id in agents) if (near(agents[id], 12)) found.agents[id]++;
    }
    return found;
  });
  const only = async (...kinds) => {
    await page.evaluate((kinds) => {
      const { view } = window.coma;
      for (const kind in view.shown) view.shown[kind] = kinds.includes(kind);
      view.show();
    }, kinds);
    await settled();
    return pixels();
  };
  const trajectories = await only("trajectories");
  const cameras = await only("cameras");
  const surfels = await only("surfels");
  const loops = await only("accepted");
  const nothing = await only();

  // A correction moves a submap's matrix; no surfels are downloaded again, not even when all states are.
  const correction = await page.evaluate(async () => {
    const { state, view, downloads } = window.coma;
    const before = JSON.stringify(downloads);
    const submap = [...state.submaps.values()].at(-1);
    const x_m = () => view.surfelMatrix(submap.id).elements[12];
    const from = x_m();
    const moved = { ...submap.map_from_submap, tx_m: submap.map_from_submap.tx_m + 1 };
    window.coma.on({ type: "correction", component: { generation: { map: submap.map }, submaps: [{ id: submap.id, map_from_submap: moved }] } });
    const until = async (holds) => {
      for (let i = 0; i < 1200 && !holds(); i++) await new Promise((done) => setTimeout(done, 50));
      return x_m() - from;
    };
    const moved_m = await until(() => Math.abs(x_m() - from) > 0.5);
    window.coma.on({ type: "again" });
    const back_m = await until(() => Math.abs(x_m() - from) < 1e-6);
    // What would be downloaded again would be so now.
    await new Promise((done) => setTimeout(done, 1000));
    return { moved_m, back_m, downloaded: JSON.stringify(downloads) !== before, downloads };
  });

  // What the page makes of packed surfels is what the gateway writes as PLY.
  const decoded = await page.evaluate(async () => {
    const { state, view } = window.coma;
    const submap = [...state.submaps.values()][0];
    const file = await (await fetch(`api/v1/submaps/${submap.id}/surfels?format=ply`)).arrayBuffer();
    const header = new TextDecoder("latin1").decode(file.slice(0, 2000));
    const at = header.indexOf("end_header\n") + 11;
    const values = [...new Float32Array(file.slice(at, at + 4 * 17))];
    const mine = view.firstSurfel(submap.id);
    const sign = Math.sign(values[13] * mine.rotation[3] + values[14] * mine.rotation[0] + values[15] * mine.rotation[1] + values[16] * mine.rotation[2]);
    const differences = {
      center: Math.max(...[0, 1, 2].map((k) => Math.abs(values[k] - mine.center[k]))),
      color: Math.max(...[0, 1, 2].map((k) => Math.abs(values[6 + k] * 0.2820948 + 0.5 - mine.color[k]))),
      opacity: Math.abs(1 / (1 + Math.exp(-values[9])) - mine.color[3]),
      scale: Math.max(...[0, 1].map((k) => Math.abs(values[10 + k] - Math.log(mine.scale[k])))),
      rotation: Math.max(...[13, 14, 15, 16].map((k, i) => Math.abs(values[k] - sign * mine.rotation[[3, 0, 1, 2][i]]))),
    };
    return differences;
  });

  const counts = await page.evaluate(() => window.coma.counts);
  console.log(JSON.stringify({ hint, counts, trajectories, cameras, surfels, loops, nothing, correction, decoded, errors }));
} finally {
  await browser.close();
}
