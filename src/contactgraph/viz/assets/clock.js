// The one time of the page: which run, where in it, whether it plays. Views listen to it.

const clock = {
  run: payload.runs[0],
  step: 0, // a real number from 0 to T; a whole number is a recorded state
  playing: false,
  speed: 1,
  span: null, // [first, last] step that the plots show; null shows the whole run
};

const timeListeners = [];
const runListeners = [];
let lastFrame = null;

function seek(step) {
  clock.step = Math.max(0, Math.min(clock.run.steps, step));
  for (const listener of timeListeners) listener();
}

function showSpan(span) {
  clock.span = span;
  for (const listener of runListeners) listener();
  seek(clock.step);
}

// Another run starts over, or, where the clock stands still, rests at its grasp.
function chooseRun(run) {
  clock.run = run;
  clock.step = clock.playing ? 0 : (run.grasp ?? 0);
  for (const listener of runListeners) listener();
  seek(clock.step);
}

function tick(now) {
  if (!clock.playing) return;
  const seconds = lastFrame === null ? 0 : Math.min(0.1, (now - lastFrame) / 1000);
  lastFrame = now;
  const next = clock.step + (seconds * clock.speed) / clock.run.dt;
  if (next >= clock.run.steps) {
    seek(clock.run.steps);
    pause();
    return;
  }
  seek(next);
  requestAnimationFrame(tick);
}

function play() {
  if (clock.playing) return;
  if (clock.step >= clock.run.steps) clock.step = 0;
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
function graspSpan(run) {
  if (run.grasp === null) return null;
  const margin = Math.round(1 / run.dt);
  return [Math.max(0, run.grasp - margin), Math.min(run.steps, run.grasp + margin)];
}
