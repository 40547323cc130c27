// Cameras, and moving them. A camera is never changed: a moved one is a new object. `rotation` turns
// the world into the camera's axes, x right, y down, z forward, row by row; lengths are world units,
// the lens is in pixels.

export const add = (a, b, factor = 1) => a.map((each, i) => each + factor * b[i]);
export const dot = (a, b) => a.reduce((sum, each, i) => sum + each * b[i], 0);
const cross = (a, b) => [0, 1, 2].map(i => {
    const j = (i + 1) % 3, k = (i + 2) % 3;
    return a[j] * b[k] - a[k] * b[j];
});
const unit = a => a.map(each => each / (Math.hypot(...a) || 1));

export const axis = (camera, i) => camera.rotation.slice(3 * i, 3 * i + 3);

// A vector, turned around an axis of length 1.
function turned(vector, around, angle) {
    const c = Math.cos(angle), s = Math.sin(angle), side = cross(around, vector);
    const along = dot(around, vector) * (1 - c);
    return vector.map((each, i) => each * c + side[i] * s + around[i] * along);
}

// The same camera with a picture of another size, all of the old one within it.
export function fitted(camera, width, height) {
    const factor = Math.min(width / camera.width, height / camera.height);
    return {
        ...camera, width, height,
        fx: camera.fx * factor, fy: camera.fy * factor,
        cx: width / 2 + (camera.cx - camera.width / 2) * factor,
        cy: height / 2 + (camera.cy - camera.height / 2) * factor,
    };
}

const STEEPEST = 0.995; // of the way to looking straight up or down

// Turn right and down, in place or around what lies at a distance ahead.
export function rotated(camera, up, right, down, distance = 0) {
    const target = add(camera.position, axis(camera, 2), distance);
    let axes = [0, 1, 2].map(i => turned(axis(camera, i), up, -right));
    const tilted = axes.map(each => turned(each, axes[0], -down));
    if (Math.abs(dot(tilted[2], up)) < STEEPEST || Math.abs(dot(tilted[2], up)) < Math.abs(dot(axes[2], up)))
        axes = tilted;
    const x = unit(axes[0]), z = unit(add(axes[2], x, -dot(axes[2], x)));
    const rotation = [...x, ...cross(z, x), ...z];
    return { ...camera, rotation, position: add(target, z, -distance) };
}

// Move along the camera's own axes.
export function moved(camera, [right, down, forward]) {
    let { position } = camera;
    [right, down, forward].forEach((way, i) => { position = add(position, axis(camera, i), way); });
    return { ...camera, position };
}

// Hands on the picture: calls back with what to do, in pixels and steps.
export function listen(element, { turn, pan, zoom, hover }) {
    const down = new Map();
    element.addEventListener("contextmenu", event => event.preventDefault());
    element.addEventListener("pointerdown", event => {
        element.setPointerCapture(event.pointerId);
        down.set(event.pointerId, [event.clientX, event.clientY]);
    });
    for (const end of ["pointerup", "pointercancel"])
        element.addEventListener(end, event => down.delete(event.pointerId));
    element.addEventListener("pointermove", event => {
        const before = down.get(event.pointerId), now = [event.clientX, event.clientY];
        if (!before) {
            hover(...now);
            return;
        }
        const across = now[0] - before[0], along = now[1] - before[1];
        if (down.size === 1) {
            if (event.buttons & 6 || event.shiftKey) pan(across, along);
            else turn(across, along);
        } else if (down.size === 2) {
            const [other] = [...down].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
            const apart = at => Math.hypot(at[0] - other[0], at[1] - other[1]) || 1;
            zoom(apart(before) / apart(now));
            pan(across / 2, along / 2);
        }
        down.set(event.pointerId, now);
    });
    element.addEventListener("wheel", event => {
        event.preventDefault();
        const lines = event.deltaMode ? event.deltaY * 16 : event.deltaY;
        zoom(Math.exp(Math.max(-120, Math.min(120, lines)) / 500));
    }, { passive: false });
}
