// The one time of the page: the scene shown, the step in it, and whether it plays. Views listen to it.

const clock = {
  scene: payload.scenes[0],
  step: 0, // a real number from 0 to T; a whole number is a recorded state
  playing: false,
  speed: 1,
  span: null, // [first, last] step that the plots show; null shows the whole trajectory
};

const timeListeners = [];
const sceneListeners = [];
let lastFrame = null;

function seek(step) {
  clock.step = Math.max(0, Math.min(clock.scene.steps, step));
  for (const listener of timeListeners) listener();
}

function showSpan(span) {
  clock.span = span;
  for (const listener of sceneListeners) listener();
  seek(clock.step);
}

// Another scene starts over, or, where the clock stands still, rests at its grasp.
function chooseScene(scene) {
  clock.scene = scene;
  clock.step = clock.playing ? 0 : (scene.grasp ?? 0);
  for (const listener of sceneListeners) listener();
  seek(clock.step);
}

function tick(now) {
  if (!clock.playing) return;
  const seconds = lastFrame === null ? 0 : Math.min(0.1, (now - lastFrame) / 1000);
  lastFrame = now;
  const next = clock.step + (seconds * clock.speed) / clock.scene.dt;
  if (next >= clock.scene.steps) {
    seek(clock.scene.steps);
    pause();
    return;
  }
  seek(next);
  requestAnimationFrame(tick);
}

function play() {
  if (clock.playing) return;
  if (clock.step >= clock.scene.steps) clock.step = 0;
  clock.playing = true;
  lastFrame = null;
  requestAnimationFrame(tick);
  seek(clock.step);
}

function pause() {
  clock.playing = false;
  seek(clock.step);
}

// About a second on either side of the grasp, where all the learning shows.
function graspSpan(scene) {
  if (scene.grasp === null) return null;
  const margin = Math.round(1 / scene.dt);
  return [Math.max(0, scene.grasp - margin), Math.min(scene.steps, scene.grasp + margin)];
}
