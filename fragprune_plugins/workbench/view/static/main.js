// The page: what is shown, and what hands and keys do.

import { add, axis, dot, fitted, listen, moved, rotated } from "./camera.js";
import { bytesOf, expanded } from "./compact.js";
import { Drawing } from "./drawing.js";
import { Splats } from "./splats.js";

const $ = selector => document.querySelector(selector);
const asked = new URLSearchParams(location.search);
const SHOWS = ["left", "split", "right"];
const MAPS = { picture: "Picture", fragments: "Fragments", quads: "Quads" };
const QUALITIES = [1, 0.71, 0.5, 0.35]; // of a side, while a slow machine moves
const SLOW = 70, FAST = 28; // milliseconds a frame
const REST = 220; // milliseconds without a movement

// A file of the page: within it, or beside it.
async function asset(name, progress = () => {}) {
    const within = document.querySelector(`script[data-name="${name}"]`);
    if (within) {
        const bytes = bytesOf(within.textContent);
        within.remove();
        return bytes;
    }
    const answer = await fetch(name);
    if (!answer.ok) throw new Error(`${name}: ${answer.status} ${answer.statusText}`);
    const total = Number(answer.headers.get("Content-Length"));
    if (!total || answer.headers.get("Content-Encoding")) return answer.arrayBuffer();
    const bytes = new Uint8Array(total), reader = answer.body.getReader();
    let at = 0;
    for (;;) {
        const { done, value } = await reader.read();
        if (done) break;
        if (at + value.length > total) throw new Error(`${name} is longer than announced.`);
        bytes.set(value, at);
        at += value.length;
        progress(at / total);
    }
    if (at < total) throw new Error(`${name} was cut off: load the page again.`);
    return bytes.buffer;
}

class Viewer {
    constructor(scene) {
        this.scene = scene;
        this.canvas = $("#picture");
        this.drawing = new Drawing(this.canvas);
        this.drawing.options.fixed = asked.get("quads") === "fixed";
        this.layers = []; // { splats, truncated, name }
        this.camera = scene.start;
        this.distance = this.ahead();
        this.up = scene.up;
        this.background = scene.background;
        this.show = "split";
        this.map = "picture";
        this.fly = false;
        this.split = 0.5;
        this.limit = 50;
        this.quality = asked.has("full") ? 1 : 0.5; // the first frame comes soon, the sharp one next
        this.firstFrame = null; // milliseconds since the page was asked for
        this.keys = new Set();
        this.dirty = true; // what is on the screen is of another camera or choice
        this.sharp = false; // what is on the screen has its full size
        this.pending = false; // a frame is being drawn
        this.last = 0; // when the last frame began, while moving
        this.before = 0; // and the one before it
        this.movedAt = -Infinity;
        this.seenAt = -Infinity; // when the last frame while moving was there
        this.counted = null; // what was counted: of which camera
        this.paused = false;
        this.frame = 0;
        new ResizeObserver(() => this.change()).observe(this.canvas);
    }

    // How far ahead the orbit's centre is: beside the middle of the scene.
    ahead() {
        const { centre, radius } = this.scene;
        const way = dot(add(centre, this.camera.position, -1), axis(this.camera, 2));
        return Math.max(way, 0.3 * radius);
    }

    addLayers(layers) {
        this.layers.push(...layers);
        for (const { splats } of layers) splats.onsorted = () => this.#sorted();
        this.change();
    }

    // An order that is one movement old will do, until the camera rests: it is drawn sharp then.
    #sorted() {
        if (this.firstFrame === null || !this.moving) this.change(false);
    }

    // Something to show has changed; a movement, too, lowers the quality on slow machines.
    change(moves = true) {
        this.dirty = true;
        if (moves) this.counted = null;
        $("#figures").classList.toggle("stale", !this.counted);
        this.#again();
    }

    go(camera, moves = true) {
        this.camera = camera;
        if (moves) this.movedAt = performance.now();
        this.change();
    }

    get two() { return this.layers.length > 1; }

    // The camera for the window: on a phone its picture lies above the panel.
    framed(quality) {
        const ratio = Math.min(window.devicePixelRatio || 1, 2) * quality;
        const [width, height] = [innerWidth, innerHeight].map(each => Math.max(1, Math.round(each * ratio)));
        const below = innerWidth <= 640 ? $("#panel").offsetHeight / innerHeight : 0;
        return { ...fitted(this.camera, width, Math.round(height * (1 - below))), height };
    }

    // The layers to draw into so many columns.
    sides(width) {
        const at = { left: width, split: Math.round(this.split * width), right: 0 }[this.two ? this.show : "left"];
        return this.layers.slice(0, 2)
            .map((layer, i) => ({ ...layer, sides: i ? [at, width] : [0, at] }))
            .filter(({ sides: [from, to] }) => to > from);
    }

    draw(quality = 1) {
        const camera = this.framed(quality);
        const counted = this.map !== "picture";
        this.drawing.draw(camera, this.sides(camera.width), { counted });
        this.drawing.show({
            background: this.background,
            limit: counted ? this.limit : 0,
            channel: this.map === "fragments" ? 1 : 0,
        });
    }

    // A hand that goes on may do so only when it sees the frame that it waits for.
    get moving() {
        return this.keys.size > 0 || performance.now() - Math.max(this.movedAt, this.seenAt) < REST;
    }

    #frame(now) {
        this.frame = 0;
        const seconds = this.last ? Math.min(0.1, (now - this.last) / 1000) : 1 / 60;
        if (this.keys.size) this.#keysMove(seconds);
        const { moving } = this, first = this.firstFrame === null;
        for (const { splats } of this.layers) splats.sort(this.camera);
        const shown = this.sides(100);
        const ready = shown.length > 0 && shown.every(({ splats }) => splats.inOrder);
        if (moving) this.sharp = false;
        if (ready && !this.pending && (this.dirty || (!moving && !this.sharp))) {
            this.dirty = false;
            const began = performance.now();
            this.draw(moving || first ? this.quality : 1);
            this.sharp = !moving && !first;
            if (!this.sharp) this.#pace(began, now);
        }
        this.last = moving ? now : 0;
        if (moving || (ready && !this.sharp)) this.#again();
        else if (ready && !this.counted && !this.dirty) this.#rest();
    }

    #again() {
        if (!this.frame && !this.paused) this.frame = requestAnimationFrame(now => this.#frame(now));
    }

    // Wait for a frame without stopping the page, and choose the resolution by how long it took.
    #pace(began, now) {
        const { gl } = this.drawing, fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
        const size = this.quality;
        this.pending = true; // one frame at a time
        gl.flush();
        const look = () => {
            if (gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) {
                setTimeout(look, 1);
                return;
            }
            gl.deleteSync(fence);
            this.pending = false;
            const milliseconds = performance.now() - began;
            if (this.firstFrame === null) {
                this.firstFrame = performance.now();
                $("#loading").hidden = true;
                return;
            }
            this.seenAt = performance.now();
            $("#ms").textContent = milliseconds.toFixed(milliseconds < 10 ? 1 : 0);
            const period = this.before ? Math.max(milliseconds, now - this.before) : 0;
            this.before = this.last && now;
            $("#fps").textContent = period ? (1000 / period).toFixed(period > 100 ? 1 : 0) : "–";
            $("#size").textContent = size < 1 ? `, at ${Math.round(size * 100)} % of the size` : "";
            if (asked.has("full") || size !== this.quality) return;
            const at = QUALITIES.indexOf(size);
            if (milliseconds > SLOW && at < QUALITIES.length - 1) this.quality = QUALITIES[at + 1];
            else if (milliseconds < FAST && at > 0) this.quality = QUALITIES[at - 1];
        };
        look();
    }

    // At rest: count and time every layer on the whole picture.
    #rest() {
        clearTimeout(this.resting);
        this.resting = setTimeout(async () => {
            const { camera } = this;
            const busy = () => this.paused || this.dirty || this.moving || this.camera !== camera
                || this.layers.some(({ splats }) => splats.inOrder !== camera);
            const pause = () => new Promise(done => setTimeout(done)); // for hands and keys
            const counted = [];
            for (const i of this.layers.keys()) {
                if (busy()) return;
                counted.push(this.measure(i));
                await pause();
            }
            const enough = performance.now() + 400; // on a busy machine a single frame says little
            for (let round = 1; round < 5 && performance.now() < enough; round++)
                for (const [i, each] of counted.entries()) {
                    if (busy()) return;
                    each.milliseconds = Math.min(each.milliseconds, this.time(i));
                    await pause();
                }
            if (busy()) return;
            this.counted = counted;
            const most = Math.max(...counted.map(each => each.most));
            this.limit = [10, 20, 50, 100, 200, 500, 1000, 2000].find(each => each >= 0.8 * most) ?? 5000;
            this.draw();
            this.#figures();
        }, 150);
    }

    // Counts and milliseconds of one layer on the whole picture, from a camera its order is of.
    measure(i, camera = this.framed(1)) {
        const layer = { ...this.layers[i], sides: [0, camera.width] };
        const pixels = camera.width * camera.height;
        this.drawing.draw(camera, [layer], { counted: true });
        const { quads, fragments, most } = this.drawing.total(layer.sides);
        return {
            fragments: fragments / pixels, quads: quads / pixels, most,
            milliseconds: this.time(i, camera), gaussians: layer.splats.count,
        };
    }

    // Milliseconds of one frame of a layer, from the first call until the picture is there.
    time(i, camera = this.framed(1)) {
        this.drawing.finish();
        const began = performance.now();
        this.drawing.draw(camera, [{ ...this.layers[i], sides: [0, camera.width] }]);
        this.drawing.show({ background: this.background, aside: true });
        this.drawing.finish();
        return performance.now() - began;
    }

    // For measuring from outside: nothing draws by itself any more, and orders are of this camera.
    async hold(camera) {
        this.paused = true;
        cancelAnimationFrame(this.frame);
        clearTimeout(this.resting);
        for (const { splats } of this.layers) await splats.settled(camera);
    }

    #figures() {
        const rows = document.querySelectorAll("#figures tbody tr");
        ["fragments", "quads", "milliseconds"].forEach((name, r) => {
            const values = this.counted.map(each => each[name]), cells = rows[r].querySelectorAll("td");
            values.forEach((value, i) => { cells[i].textContent = value.toFixed(value < 100 ? 1 : 0); });
            if (values.length > 1)
                cells[2].textContent = values[1] > 0 ? `${(values[0] / values[1]).toFixed(2)}×` : "–";
        });
        $("#figures").classList.remove("stale");
        this.legend();
    }

    legend() {
        const [, middle, end] = document.querySelectorAll("#legend .ticks span");
        [middle.textContent, end.textContent] = [this.limit / 2, `${this.limit} and more`];
        $("#legend p").textContent =
            this.map === "quads" ? "quad pixels per pixel" : "drawn fragments per pixel";
        $("#legend").hidden = this.map === "picture";
    }

    #keysMove(seconds) {
        const fast = this.keys.has("shift") ? 4 : 1;
        const step = 0.45 * this.scene.radius * seconds * fast, angle = 0.9 * seconds;
        const on = key => Number(this.keys.has(key));
        const way = [on("d") - on("a"), on("q") - on("e"), on("w") - on("s")];
        const turn = [on("arrowright") - on("arrowleft"), on("arrowdown") - on("arrowup")];
        if (way.some(Boolean)) this.go(moved(this.camera, way.map(each => each * step)));
        if (turn.some(Boolean)) this.turn(turn[0] * angle, turn[1] * angle);
    }

    turn(right, down) {
        const sign = this.fly ? 1 : -1; // around a model, the hand takes the model
        const about = this.fly ? 0 : this.distance;
        this.go(rotated(this.camera, this.up, sign * right, sign * down, about));
    }
}

function choices(fieldset, options, chosen, pick) {
    for (const [value, label] of Object.entries(options)) {
        const line = document.createElement("label"), input = document.createElement("input");
        Object.assign(input, { type: "radio", name: fieldset.id, value, checked: value === chosen });
        input.addEventListener("change", () => pick(value));
        const text = document.createElement("span");
        text.textContent = text.title = label;
        line.append(input, text);
        fieldset.append(line);
    }
}

const choose = (name, value) => $(`#${name} input[value="${value}"]`)?.click();

function wire(viewer) {
    const { scene } = viewer;
    const perPixel = () => 2 / Math.min(innerWidth, innerHeight);
    listen(viewer.canvas, {
        turn: (x, y) => viewer.turn(1.5 * x * perPixel(), 1.5 * y * perPixel()),
        pan: (x, y) => {
            const step = viewer.distance / fitted(viewer.camera, innerWidth, innerHeight).fx;
            viewer.go(moved(viewer.camera, [-x * step, -y * step, 0]));
        },
        zoom: factor => {
            const least = 0.02 * scene.radius;
            const distance = viewer.fly ? viewer.distance : Math.max(least, viewer.distance * factor);
            const way = viewer.fly ? -Math.log(factor) * scene.radius * 0.5 : viewer.distance - distance;
            viewer.distance = distance;
            viewer.go(moved(viewer.camera, [0, 0, way]));
        },
        hover: (x, y) => {
            const reading = $("#reading");
            reading.hidden = viewer.map === "picture" || !viewer.counted;
            if (reading.hidden) return;
            const ratio = viewer.drawing.width / innerWidth;
            const { quads, fragments } = viewer.drawing.countsAt(Math.floor(x * ratio), Math.floor(y * ratio));
            reading.textContent = `${fragments} drawn of ${quads}`;
            reading.style.transform = `translate(${Math.min(x + 14, innerWidth - 150)}px, ${y + 14}px)`;
        },
    });
    viewer.canvas.addEventListener("webglcontextlost", () =>
        failed(new Error("The graphics card has let go of the page: load it again.")));
    viewer.canvas.addEventListener("pointerleave", () => { $("#reading").hidden = true; });

    choices($("#maps"), MAPS, "picture", value => {
        viewer.map = value;
        viewer.legend();
        $("#reading").hidden = true;
        viewer.change(false);
    });
    choices($("#moves"), { orbit: "Orbit", fly: "Fly" }, "orbit", value => { viewer.fly = value === "fly"; });

    let number = -1;
    const select = $("#cameras select"), photo = $("#photo");
    const photograph = () => {
        const camera = scene.cameras[number], shown = photo.getAttribute("aria-pressed") === "true";
        photo.hidden = !scene.cameras.some(each => each.photograph);
        $("#photograph").hidden = !(shown && camera?.photograph);
        if ($("#photograph").hidden) return;
        $("#photograph img").src = address(camera.photograph);
        $("#photograph img").alt = $("#photograph figcaption").textContent = `Photograph ${camera.name}`;
    };
    const look = camera => {
        viewer.go(camera, false);
        viewer.distance = viewer.ahead();
    };
    const pick = chosen => {
        number = chosen;
        select.value = chosen;
        look(scene.cameras[chosen]);
        photograph();
    };
    if (scene.cameras.length) {
        scene.cameras.forEach(({ name }, i) => select.add(new Option(name, i)));
        $("#cameras").hidden = false;
        number = 0;
        select.addEventListener("change", () => pick(Number(select.value)));
    }
    photo.addEventListener("click", () => {
        photo.setAttribute("aria-pressed", photo.getAttribute("aria-pressed") !== "true");
        photograph();
    });
    photograph();

    const theme = value => {
        document.documentElement.dataset.theme = value;
    };
    theme(matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark");
    $("#theme").addEventListener("click", () =>
        theme(document.documentElement.dataset.theme === "light" ? "dark" : "light"));
    $("#ground").addEventListener("click", () => {
        viewer.background = viewer.background.map(each => 1 - each);
        viewer.change(false);
    });
    $("#ask").addEventListener("click", () => $("#help").showModal());
    $("#reset").addEventListener("click", () => look(scene.start));
    const bare = () => {
        document.body.classList.toggle("bare");
        viewer.change(false);
    };
    for (const name of ["#hide", "#back"]) $(name).addEventListener("click", bare);
    $("#whole").hidden = !document.fullscreenEnabled;
    $("#whole").addEventListener("click", () =>
        document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen());

    const split = $("#split");
    const place = share => {
        if (viewer.firstFrame !== null) viewer.movedAt = performance.now();
        viewer.split = Math.max(0, Math.min(1, share));
        split.style.left = `${100 * viewer.split}%`;
        split.setAttribute("aria-valuenow", Math.round(100 * viewer.split));
        viewer.change(false);
        names();
    };
    const names = viewer.names = () => {
        const phone = innerWidth <= 640, at = viewer.split * innerWidth;
        const [left, right] = [$("#left"), $("#right")];
        const shown = { left: [1, 0], split: [1, 1], right: [0, 1] }[viewer.two ? viewer.show : "left"];
        [left, right].forEach((each, i) => {
            each.textContent = viewer.two && shown[i] ? viewer.layers[i].name : "";
        });
        split.hidden = !viewer.two || viewer.show !== "split";
        if (viewer.show === "split") {
            left.style.cssText = `right: ${innerWidth - at + 20}px; left: auto`;
            right.style.cssText = `left: ${at + 20}px`;
        } else for (const each of [left, right]) each.style.cssText = phone ? "left: 8px" : "left: 50%";
    };
    split.addEventListener("pointerdown", event => split.setPointerCapture(event.pointerId));
    split.addEventListener("pointermove", event => {
        if (event.buttons) place(event.clientX / innerWidth);
    });
    split.addEventListener("keydown", event => {
        const step = { ArrowLeft: -0.02, ArrowRight: 0.02, Home: -1, End: 1 }[event.key];
        if (!step) return;
        event.preventDefault();
        event.stopPropagation();
        place(viewer.split + step);
    });
    addEventListener("resize", names);
    place(0.5);

    const MOVES = new Set([..."wasdqe", "shift", "arrowleft", "arrowright", "arrowup", "arrowdown"]);
    addEventListener("keydown", event => {
        const key = event.key.toLowerCase();
        if (event.ctrlKey || event.metaKey || event.altKey || $("#help").open) return;
        const within = name => event.target.closest?.(name);
        if (within("select") || (within("fieldset") && key.startsWith("arrow"))) return;
        if (MOVES.has(key)) {
            if (key !== "shift" || viewer.keys.size) event.preventDefault();
            viewer.keys.add(key);
            if (key !== "shift") viewer.change();
        } else if (key >= "1" && key <= "3") choose("sides", SHOWS[key - 1]);
        else if (key === "o") {
            const all = Object.keys(MAPS);
            choose("maps", all[(all.indexOf(viewer.map) + 1) % all.length]);
        } else if (key === "f") choose("moves", viewer.fly ? "orbit" : "fly");
        else if (key === "c" && scene.cameras.length) pick((number + 1) % scene.cameras.length);
        else if (key === "p") photo.click();
        else if (key === "b") $("#ground").click();
        else if (key === "t") $("#theme").click();
        else if (key === "h") bare();
        else if (key === "r") $("#reset").click();
        else if (key === "?") $("#help").showModal();
    });
    addEventListener("keyup", event => {
        viewer.keys.delete(event.key.toLowerCase());
        if (viewer.keys.size === 1 && viewer.keys.has("shift")) viewer.keys.clear();
    });
    addEventListener("blur", () => viewer.keys.clear());
}

// Two layers: their names, and which of them to show.
function sides(viewer) {
    document.body.classList.toggle("single", !viewer.two);
    const heads = document.querySelectorAll("#figures thead th");
    viewer.layers.forEach(({ name }, i) => { heads[i].textContent = heads[i].title = name; });
    if (viewer.two && $("#sides").hidden) {
        $("#sides").hidden = false;
        const [left, right] = viewer.layers.map(each => each.name);
        choices($("#sides"), { left, split: "Split", right }, viewer.show, value => {
            viewer.show = value;
            viewer.names();
            viewer.change(false);
        });
    }
    viewer.names();
}

function address(name) {
    const within = document.querySelector(`script[data-name="${name}"]`);
    return within ? `data:image/jpeg;base64,${within.textContent.trim()}` : name;
}

async function start() {
    const scene = JSON.parse(new TextDecoder().decode(await asset("scene.json")));
    const viewer = window.viewer = new Viewer(scene);
    $("#title").textContent = document.title = scene.title;
    $("#loading span").textContent = "Loading";
    const bar = $("#loading progress");
    wire(viewer);
    for (const [number, facts] of scene.models.entries()) {
        const held = await asset(facts.file, part => { bar.value = part; });
        const buffer = facts.bits === undefined ? held : await expanded(held, facts);
        const splats = new Splats(viewer.drawing.gl, facts, buffer);
        const layers = scene.layers.filter(({ model }) => model === number);
        viewer.addLayers(layers.map(({ truncated, name }) => ({ splats, truncated, name })));
        sides(viewer);
    }
    const counts = scene.models.map(({ gaussians }) => gaussians.toLocaleString("en"));
    $("#about").textContent = `${[...new Set(counts)].join(" and ")} Gaussians`;
    const stop = Math.max(...scene.models.map(({ stop }) => stop ?? 0));
    if (stop > 0)  // they are looked at between portions
        $("#about").textContent += `. A pixel ends once ${+(100 * stop).toPrecision(3)} % of its light is left; `
            + "this viewer ends it a few fragments later";
    if (scene.models.some(({ rim }) => rim === "soft"))
        $("#about").textContent += ". Its rims are soft, across a pixel; this viewer draws them hard";
}

function failed(error) {
    $("#loading").hidden = false;
    $("#loading span").textContent = error.message;
    $("#loading progress").hidden = true;
}

start().catch(error => {
    failed(error);
    throw error;
});
