// Draws models into a canvas. Quads go front to back in portions; between portions, pixels that are
// full are marked in the depth buffer, and no fragment is shaded there any more.

import { FRAGMENT, MARK, PROJECT, QUADS, ROW, SHOW, SUM, WHOLE } from "./shaders.js";
import { texture } from "./splats.js";

const PORTION = 8191; // Gaussians: their corners have 16-bit numbers, and 65535 means a new strip
const BLOCK = 16; // pixels of a side that are summed at once

export class Drawing {
    constructor(canvas) {
        const gl = canvas.getContext("webgl2", {
            antialias: false, alpha: false, depth: false, powerPreference: "high-performance",
        });
        if (!gl) throw new Error("This browser has no WebGL2.");
        const float = gl.getExtension("EXT_color_buffer_float");
        if (!float && !gl.getExtension("EXT_color_buffer_half_float"))
            throw new Error("This browser cannot draw into pictures of 16-bit floats.");
        this.exact = Boolean(float && gl.getExtension("EXT_float_blend"));
        const info = gl.getExtension("WEBGL_debug_renderer_info");
        this.renderer = gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
        // Half floats are enough for the picture. In software their blending takes twice as long.
        const software = /swiftshader|llvmpipe/i.test(this.renderer);
        this.format = software && this.exact ? gl.RGBA32F : gl.RGBA16F;
        this.gl = gl;
        this.canvas = canvas;
        // Ellipses of more square pixels get octagons. In software two triangles less are worth more.
        this.options = { fixed: false, stop: true, marks: 16, large: software ? Infinity : 36 };
        this.programs = new Map();
        gl.disable(gl.DITHER);
        gl.bindVertexArray(gl.createVertexArray());
        // Corners 0 to 7 go around an octagon; every second one is a rectangle's.
        this.shapes = [[0, 1, 2, 0, 2, 3, 0, 3, 4, 0, 4, 7, 4, 5, 6, 4, 6, 7], [0, 2, 4, 0, 4, 6]].map(shape => {
            const corners = new Uint16Array(PORTION * shape.length), buffer = gl.createBuffer();
            for (let i = 0; i < PORTION; i++)
                corners.set(shape.map(each => i * 8 + each), i * shape.length);
            gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
            gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
            return { buffer, length: shape.length };
        });
        this.tableRows = 0;
        this.width = this.height = 0;
    }

    // Draw layers, each { splats, truncated, sides: [first column, past the last] }, from a camera.
    draw(camera, layers, { counted = false } = {}) {
        const { gl } = this;
        this.#resize(camera.width, camera.height, counted);
        gl.enable(gl.SCISSOR_TEST);
        for (const layer of layers) {
            const [from, to] = layer.sides;
            if (to <= from) continue;
            gl.disable(gl.SCISSOR_TEST);
            this.#project(camera, layer);
            gl.enable(gl.SCISSOR_TEST);
            gl.scissor(from, 0, to - from, this.height);
            this.#blend(layer, counted);
        }
        gl.disable(gl.SCISSOR_TEST);
    }

    // Put the picture, or counts as colours, on the canvas; or aside, where nobody sees it.
    show({ background = [0, 0, 0], limit = 0, channel = 0, aside = false } = {}) {
        const { gl } = this;
        const use = this.#use("show", WHOLE, SHOW);
        gl.bindFramebuffer(gl.FRAMEBUFFER, aside ? this.aside : null);
        gl.viewport(0, 0, this.width, this.height);
        this.#bind(0, this.color, use("u_color"));
        this.#bind(1, limit > 0 ? this.counts : this.color, use("u_counts"));
        gl.uniform3fv(use("u_background"), background);
        gl.uniform1f(use("u_limit"), limit);
        gl.uniform1i(use("u_channel"), channel);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
    }

    // What was counted in some columns: pixels that quads covered, and fragments that were drawn.
    total([from, to]) {
        const { gl } = this;
        const width = Math.ceil(this.width / BLOCK), height = Math.ceil(this.height / BLOCK);
        const use = this.#use("sum", WHOLE, SUM(BLOCK));
        gl.bindFramebuffer(gl.FRAMEBUFFER, this.sumTarget);
        gl.viewport(0, 0, width, height);
        this.#bind(0, this.counts, use("u_counts"));
        gl.uniform2i(use("u_sides"), from, to);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
        const sums = new Float32Array(width * height * 4);
        gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, sums);
        const total = { quads: 0, fragments: 0, most: 0 };
        for (let i = 0; i < sums.length; i += 4) {
            total.quads += sums[i];
            total.fragments += sums[i + 1];
            total.most = Math.max(total.most, sums[i] / BLOCK ** 2);
        }
        return total;
    }

    // Counts at one pixel, from the top left.
    countsAt(x, y) {
        const { gl } = this, found = new Float32Array(4);
        gl.bindFramebuffer(gl.FRAMEBUFFER, this.countTarget);
        gl.readBuffer(gl.COLOR_ATTACHMENT1);
        gl.readPixels(x, this.height - 1 - y, 1, 1, gl.RGBA, gl.FLOAT, found);
        return { quads: found[0], fragments: found[1] };
    }

    // Wait until what was shown aside is there.
    finish() {
        const { gl } = this;
        gl.bindFramebuffer(gl.FRAMEBUFFER, this.aside);
        gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    }

    #project(camera, { splats, truncated, sides }) {
        const { gl } = this, rows = Math.ceil(splats.count / ROW);
        if (rows > this.tableRows) {
            for (const each of [this.shape, this.paint]) gl.deleteTexture(each);
            this.tableRows = Math.ceil(rows * 1.25);
            [this.shape, this.paint] = [0, 1].map(() => texture(gl, gl.RGBA32UI, ROW, this.tableRows));
            this.table = this.#target([this.shape, this.paint]);
        }
        if (!rows) return;
        const { degree, scales } = splats.facts;
        const use = this.#use(`project${degree}`, WHOLE, PROJECT(degree));
        gl.bindFramebuffer(gl.FRAMEBUFFER, this.table);
        gl.viewport(0, 0, ROW, rows);
        gl.disable(gl.DEPTH_TEST);
        gl.disable(gl.BLEND);
        this.#bind(0, splats.geometry, use("u_geometry"));
        this.#bind(1, splats.harmonics, use("u_harmonics"));
        this.#bind(2, splats.order, use("u_order"));
        gl.uniform1i(use("u_count"), splats.count);
        gl.uniformMatrix3fv(use("u_rotation"), true, camera.rotation);
        gl.uniform3fv(use("u_position"), camera.position);
        gl.uniform4f(use("u_lens"), camera.fx, camera.fy, camera.cx, camera.cy);
        gl.uniform2f(use("u_size"), camera.width, camera.height);
        gl.uniform2fv(use("u_sides"), sides);
        gl.uniform2fv(use("u_scales"), scales);
        gl.uniform1i(use("u_truncated"), truncated);
        gl.uniform1i(use("u_fixed"), this.options.fixed);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
    }

    #blend({ splats: { count, facts }, truncated }, counted) {
        const { gl } = this, applies = truncated || !facts.truncated;
        const least = Math.max(1 / 512, applies ? facts.stop ?? 0 : 0); // light of a pixel that goes on
        gl.viewport(0, 0, this.width, this.height);
        gl.bindFramebuffer(gl.FRAMEBUFFER, counted ? this.countTarget : this.target);
        gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 1]);
        if (counted) gl.clearBufferfv(gl.COLOR, 1, [0, 0, 0, 1]);
        gl.depthMask(true);
        gl.clearBufferfi(gl.DEPTH_STENCIL, 0, 1, 0);
        gl.enable(gl.DEPTH_TEST);
        gl.enable(gl.BLEND);
        // Alpha is the light that is left. What is counted has alpha 0, and so adds up.
        gl.blendFuncSeparate(gl.DST_ALPHA, gl.ONE, gl.ZERO, gl.ONE_MINUS_SRC_ALPHA);
        const { stop, marks, fixed } = this.options;
        const large = fixed ? Infinity : this.options.large;
        const { buffer, length } = this.shapes[large === Infinity ? 1 : 0];
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
        const portion = stop ? Math.min(PORTION, Math.max(1024, Math.ceil(count / marks))) : PORTION;
        for (let first = 0; first < count; first += portion) {
            if (stop && first) this.#mark(least);
            gl.bindFramebuffer(gl.FRAMEBUFFER, counted ? this.countTarget : this.target);
            const use = this.#use(counted ? "counted" : "quads", QUADS, FRAGMENT(counted));
            gl.depthFunc(gl.LEQUAL);
            gl.depthMask(false);
            this.#bind(0, this.shape, use("u_shape"));
            this.#bind(1, this.paint, use("u_paint"));
            gl.uniform2f(use("u_size"), this.width, this.height);
            gl.uniform1i(use("u_first"), first);
            gl.uniform1f(use("u_large"), large);
            const quads = Math.min(portion, count - first);
            gl.drawElements(gl.TRIANGLES, quads * length, gl.UNSIGNED_SHORT, 0);
        }
        gl.disable(gl.DEPTH_TEST);
        gl.disable(gl.BLEND);
    }

    #mark(least) {
        const { gl } = this;
        const use = this.#use("mark", WHOLE, MARK);
        gl.bindFramebuffer(gl.FRAMEBUFFER, this.marks);
        gl.depthFunc(gl.ALWAYS);
        gl.depthMask(true);
        gl.depthRange(0, 0);
        this.#bind(0, this.color, use("u_color"));
        gl.uniform1f(use("u_least"), least);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
        gl.depthRange(0, 1);
    }

    #resize(width, height, counted) {
        const { gl } = this;
        if (width !== this.width || height !== this.height) {
            [this.width, this.height] = [width, height];
            Object.assign(this.canvas, { width, height });
            for (const each of [this.color, this.sums, this.counts, this.plain]) gl.deleteTexture(each);
            for (const each of [this.target, this.marks, this.sumTarget, this.countTarget, this.aside])
                gl.deleteFramebuffer(each);
            gl.deleteRenderbuffer(this.depth);
            this.counts = null;
            this.color = texture(gl, this.format, width, height);
            this.sums = texture(gl, gl.RGBA32F, Math.ceil(width / BLOCK), Math.ceil(height / BLOCK));
            this.depth = gl.createRenderbuffer();
            gl.bindRenderbuffer(gl.RENDERBUFFER, this.depth);
            gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH24_STENCIL8, width, height);
            this.target = this.#target([this.color], this.depth);
            this.marks = this.#target([], this.depth);
            this.sumTarget = this.#target([this.sums]);
            this.plain = texture(gl, gl.RGBA8, width, height);
            this.aside = this.#target([this.plain]);
        }
        if (counted && !this.counts) {
            this.counts = texture(gl, this.exact ? gl.RGBA32F : gl.RGBA16F, width, height);
            this.countTarget = this.#target([this.color, this.counts], this.depth);
        }
    }

    #target(textures, depth) {
        const { gl } = this, made = gl.createFramebuffer();
        gl.bindFramebuffer(gl.FRAMEBUFFER, made);
        const places = textures.map((each, i) => {
            gl.framebufferTexture2D(
                gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, each, 0);
            return gl.COLOR_ATTACHMENT0 + i;
        });
        gl.drawBuffers(places);
        if (depth)
            gl.framebufferRenderbuffer(
                gl.FRAMEBUFFER, gl.DEPTH_STENCIL_ATTACHMENT, gl.RENDERBUFFER, depth);
        return made;
    }

    #bind(unit, what, where) {
        const { gl } = this;
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(gl.TEXTURE_2D, what);
        gl.uniform1i(where, unit);
    }

    // The program of a name, compiled when first used: gives where its uniforms are.
    #use(name, vertex, fragment) {
        const { gl } = this;
        if (!this.programs.has(name)) {
            const program = gl.createProgram();
            for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
                const shader = gl.createShader(kind);
                gl.shaderSource(shader, source);
                gl.compileShader(shader);
                if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS))
                    throw new Error(`${name}: ${gl.getShaderInfoLog(shader)}`);
                gl.attachShader(program, shader);
            }
            gl.linkProgram(program);
            if (!gl.getProgramParameter(program, gl.LINK_STATUS))
                throw new Error(`${name}: ${gl.getProgramInfoLog(program)}`);
            const places = new Map();
            this.programs.set(name, {
                program,
                at: uniform => {
                    if (!places.has(uniform))
                        places.set(uniform, gl.getUniformLocation(program, uniform));
                    return places.get(uniform);
                },
            });
        }
        const { program, at } = this.programs.get(name);
        gl.useProgram(program);
        return at;
    }
}
