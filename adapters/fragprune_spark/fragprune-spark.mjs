/**
 * Cutoffs for Spark on three.js: each splat's quad ends where its learned threshold says.
 *
 *     const fileBytes = await (await fetch('for_viewer.ply')).arrayBuffer();
 *     const cutoffs = readCutoffs(fileBytes);         // of the PLY's column trunc_threshold
 *     const mesh = new SplatMesh({ fileBytes });
 *     await installCutoffs(spark, mesh, { cutoffs }); // Uint8Array: a code per row of the file
 *
 * A code c is the threshold 255^(c/256 - 1) of the falloff exp(-q/2), q the squared distance in
 * standard deviations. A splat of a mesh with cutoffs ends there, or where its alpha falls below
 * 1/255, and never beyond Spark's own extent. Spark's vertex shader gets one statement for that. Other
 * meshes, and a file without cutoffs, stay as they are.
 */
import * as THREE from 'three';

const SUPPORTED = '@sparkjsdev/spark 2.0 to 2.2';
const COLUMN = 'trunc_threshold';
const WIDTH = 2048; // of the texture of codes; Spark starts each mesh at a multiple of it

function fail(found, remedy) {
    return new Error(`fragprune: ${found} (three.js r${THREE.REVISION}; supported: ${SUPPORTED}). ${remedy}`);
}

/** Code of a threshold: the nearest step in Q = -2 ln threshold. */
export function encode(threshold) {
    if (!(threshold >= 0 && threshold <= 1)) throw new RangeError(`fragprune: threshold ${threshold}`);
    return Math.min(255, Math.max(0, Math.round(256 + (256 * Math.log(threshold)) / Math.log(255))));
}

const SIZES = { char: 1, uchar: 1, short: 2, ushort: 2, int: 4, uint: 4, float: 4, double: 8,
    int8: 1, uint8: 1, int16: 2, uint16: 2, int32: 4, uint32: 4, float32: 4, float64: 8 };

/**
 * Codes of the rows of a binary PLY that has the float column trunc_threshold.
 *
 * @param {ArrayBuffer|Uint8Array} file - The whole file.
 * @returns {Uint8Array|null} A code per row, in the order of the file; null without the column.
 */
export function readCutoffs(file) {
    const bytes = file instanceof ArrayBuffer ? new Uint8Array(file) : file;
    const text = new TextDecoder('latin1').decode(bytes.subarray(0, 65536));
    const end = text.match(/^ply\r?\n[^]*?\nend_header\r?\n/)?.[0];
    if (!end) throw fail('not a PLY file', 'Pass its bytes, not compressed.');
    let [rows, stride, at, element] = [0, 0, -1, ''];
    for (const [kind, type, name] of end.split(/\r?\n/).map((line) => line.split(' '))) {
        if (kind === 'format' && type !== 'binary_little_endian') throw fail(`a PLY in ${type}`, 'Write it binary.');
        if (kind === 'element' && !element && type !== 'vertex') throw fail(`a PLY of ${type} first`, 'Use a splat PLY.');
        if (kind === 'element' && !element) rows = Number(name);
        if (kind === 'element') element = type;
        if (kind !== 'property' || element !== 'vertex') continue;
        if (name === COLUMN && SIZES[type] !== 4) throw fail(`a column ${COLUMN} of ${type}`, 'Write it as float.');
        if (name === COLUMN) at = stride;
        stride += SIZES[type];
    }
    if (at < 0) return null;
    if (!(bytes.length >= end.length + rows * stride)) throw fail('the file ends too early', 'Load it again.');
    const view = new DataView(bytes.buffer, bytes.byteOffset + end.length + at);
    return Uint8Array.from({ length: rows }, (_, row) => encode(view.getFloat32(row * stride, true)));
}

/**
 * Let the splats of a mesh end at their cutoffs.
 *
 * @param {SparkRenderer} spark - The renderer of the scene.
 * @param {SplatMesh} mesh - Loaded or loading, without LoD.
 * @param {object} options
 * @param {Uint8Array|null} options.cutoffs - A code per splat, in the order of the file. null, as
 * readCutoffs says where a file has none, changes nothing.
 * @returns {Promise<boolean>} Whether there are cutoffs.
 */
export async function installCutoffs(spark, mesh, { cutoffs } = {}) {
    if (cutoffs === null) return false;
    if (!(cutoffs instanceof Uint8Array)) throw fail('cutoffs are not a Uint8Array', 'Pass codes of 8 bits.');
    const shader = patched(spark);
    await mesh.initialized;
    if (mesh.paged || lod(mesh)) throw fail('the mesh has LoD', 'Load it with enableLod: false.');
    const count = mesh.splats?.getNumSplats?.();
    if (count !== cutoffs.length) throw wrongCount(cutoffs, count);
    if (shader) install(spark, shader);
    installed.get(spark).set(mesh, cutoffs);
    return true;
}

const lod = (mesh) => mesh.enableLod !== false && !!(mesh.packedSplats?.lodSplats ?? mesh.extSplats?.lodSplats);

function wrongCount(cutoffs, count) {
    return fail(`${cutoffs.length} cutoffs for ${count} splats`, 'Pass those of this very file.');
}

const installed = new WeakMap(); // SparkRenderer -> WeakMap of SplatMesh -> codes

// Before this line the shader has the ellipse's half axes in pixels (scale1, scale2), the corner in
// standard deviations (vSplatUv) and the quad's extent (adjustedStdDev), at which fragments end.
const ANCHOR = 'vec2 pixelOffset = position.x * eigenVec1 * scale1 + position.y * eigenVec2 * scale2;';
const DECLARED = 'uniform usampler2D ordering;';
const STEP = ((2 * Math.log(255)) / 256).toFixed(10);

const SHRINK = `
    // 0: a mesh without cutoffs; else the code plus one. Above 1 alpha means another kernel.
    uint stored = texelFetch(fragpruneCutoffs, ivec2(splatIndex % ${WIDTH}u, splatIndex / ${WIDTH}u), 0).r;
    if (stored > 0u && rgba.a <= 1.0) {
        float squared = min(float(257u - stored) * ${STEP}, 2.0 * log(255.0 * rgba.a));
        if (squared <= 0.0) return;
        float shrink = min(1.0, sqrt(squared) / adjustedStdDev);
        scale1 *= shrink;
        scale2 *= shrink;
        vSplatUv *= shrink;
        adjustedStdDev *= shrink;
    }
    `;

/** The vertex shader with cutoffs; undefined if this renderer has it. Changes nothing. */
function patched(spark) {
    if (installed.has(spark)) return undefined;
    const needed = {
        'spark.material.vertexShader': spark?.material?.vertexShader,
        'spark.uniforms': spark?.uniforms,
        'spark.display.mapping': spark?.display?.mapping
    };
    const missing = Object.keys(needed).filter((name) => !needed[name]);
    if (missing.length) throw fail(`no ${missing.join(', ')}`, 'Use a supported Spark.');
    const shader = spark.material.vertexShader;
    for (const anchor of [ANCHOR, DECLARED]) {
        const count = shader.split(anchor).length - 1;
        if (count !== 1) {
            throw fail(`Spark's vertex shader has ${count || 'no'} lines "${anchor}", not one`, 'Use a supported Spark.');
        }
    }
    return shader
        .replace(DECLARED, `${DECLARED}\nuniform highp usampler2D fragpruneCutoffs;`)
        .replace(ANCHOR, `${SHRINK}${ANCHOR}`);
}

function install(spark, shader) {
    const meshes = new WeakMap();
    let held = { key: null, texture: texture(1) };
    const draw = spark.onBeforeRender;
    spark.uniforms.fragpruneCutoffs = { value: held.texture };
    spark.material.vertexShader = shader;
    spark.material.needsUpdate = true;
    spark.onBeforeRender = function (...given) {
        draw.apply(this, given);
        // Spark draws the splats of all meshes as one; this is where each mesh lies in it.
        const { mapping } = (spark.constructor.sparkOverride ?? spark).display;
        const parts = mapping.filter(({ node }) => meshes.has(node));
        const key = parts.map(({ node, base, count }) => `${node.uuid} ${base} ${count}`).join();
        if (key === held.key && parts.every(({ node }, i) => meshes.get(node) === held.codes[i])) return;
        held.texture.dispose();
        held = { key, codes: parts.map(({ node }) => meshes.get(node)), texture: lay(parts, meshes) };
        spark.uniforms.fragpruneCutoffs.value = held.texture;
    };
    installed.set(spark, meshes);
}

/** A texture of codes in the order of Spark's splats. */
function lay(parts, meshes) {
    const size = Math.max(1, ...parts.map(({ base, count }) => base + count));
    const made = texture(Math.ceil(size / WIDTH));
    for (const { node, base, count } of parts) {
        const codes = meshes.get(node);
        if (lod(node)) throw fail('the mesh has LoD now', 'Set mesh.enableLod = false.');
        if (codes.length !== count) throw wrongCount(codes, count);
        for (let i = 0; i < count; i++) made.image.data[base + i] = codes[i] + 1;
    }
    return made;
}

function texture(rows) {
    const made = new THREE.DataTexture(new Uint16Array(WIDTH * rows), WIDTH, rows,
        THREE.RedIntegerFormat, THREE.UnsignedShortType);
    made.internalFormat = 'R16UI';
    made.needsUpdate = true;
    return made;
}
