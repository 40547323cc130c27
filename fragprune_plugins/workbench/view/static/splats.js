// One model on the GPU, and the worker that sorts it.

import { ROW } from "./shaders.js";
import { sorting } from "./sorting.js";

export class Splats {
    // facts: of scene.json; buffer: what packing.py writes.
    constructor(gl, facts, buffer) {
        const { gaussians, degree, scales } = facts;
        this.gl = gl;
        this.facts = facts;
        this.count = 0; // in the order
        this.sorted = 0; // milliseconds of the last sort
        const geometry = new Uint32Array(buffer, 0, gaussians * 8);
        const harmonics = new Uint32Array(buffer, gaussians * 32);
        if (harmonics.length !== gaussians * 4 * Math.ceil((3 * (degree + 1) ** 2) / 8))
            throw new Error(`${facts.file} was cut off: load the page again.`);
        this.geometry = table(gl, geometry);
        this.harmonics = table(gl, harmonics);
        this.order = null;
        this.rows = 0; // of the order's texture

        const words = new Float32Array(buffer, 0, gaussians * 8);
        const means = new Float32Array(gaussians * 3), reaches = new Float32Array(gaussians);
        for (let i = 0; i < gaussians; i++) {
            for (let k = 0; k < 3; k++) means[i * 3 + k] = words[i * 8 + k];
            const largest = Math.max(
                geometry[i * 8 + 6] & 65535, geometry[i * 8 + 6] >>> 16, geometry[i * 8 + 7] & 65535);
            const deviation = Math.exp(scales[0] + (largest / 65535) * (scales[1] - scales[0]));
            reaches[i] = deviation * Math.sqrt(2 * Math.log(255));
        }
        const source = new Blob([`(${sorting})()`], { type: "text/javascript" });
        this.worker = new Worker(URL.createObjectURL(source));
        this.worker.postMessage({ means, reaches }, [means.buffer, reaches.buffer]);
        this.worker.onmessage = ({ data }) => this.#sorted(data);
        this.waiting = null; // a camera that came while the worker was busy
        this.busy = null; // the camera that is being sorted
        this.inOrder = null; // the camera of the order
        this.onsorted = () => {};
    }

    // Sort for a camera; of several that wait only the last is sorted.
    sort(camera) {
        if (camera === this.inOrder || camera === this.busy) return;
        if (this.busy) {
            this.waiting = camera;
            return;
        }
        this.busy = camera;
        this.worker.postMessage({ camera });
    }

    // Wait until the order is that of a camera.
    async settled(camera) {
        this.sort(camera);
        while (this.inOrder !== camera) await new Promise(done => setTimeout(done, 1));
    }

    #sorted({ order, milliseconds }) {
        const { gl } = this;
        const rows = Math.ceil(order.length / ROW);
        if (rows > this.rows) {
            gl.deleteTexture(this.order);
            this.rows = Math.min(Math.ceil(rows * 1.25), Math.ceil(this.facts.gaussians / ROW));
            this.order = texture(gl, gl.R32UI, ROW, this.rows);
        }
        if (this.order) upload(gl, this.order, order, gl.RED_INTEGER, 1);
        this.count = order.length;
        this.sorted = milliseconds;
        const next = this.waiting;
        [this.inOrder, this.busy, this.waiting] = [this.busy, null, null];
        if (next) this.sort(next);
        this.onsorted();
    }
}

export function texture(gl, format, width, height) {
    const largest = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    if (height > largest)
        throw new Error(`This model is too large for this graphics card: ${height} rows of at most ${largest}.`);
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
        gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    return made;
}

// Words, so many to a texel, row by row.
function upload(gl, into, words, format, each) {
    const texels = words.length / each, rows = Math.floor(texels / ROW), rest = texels % ROW;
    gl.bindTexture(gl.TEXTURE_2D, into);
    const put = (y, width, height, start) => gl.texSubImage2D(
        gl.TEXTURE_2D, 0, 0, y, width, height, format, gl.UNSIGNED_INT,
        words.subarray(start * each, (start + width * height) * each));
    if (rows) put(0, ROW, rows, 0);
    if (rest) put(rows, rest, 1, rows * ROW);
}

function table(gl, words) {
    const made = texture(gl, gl.RGBA32UI, ROW, Math.ceil(words.length / 4 / ROW));
    upload(gl, made, words, gl.RGBA_INTEGER, 4);
    return made;
}
