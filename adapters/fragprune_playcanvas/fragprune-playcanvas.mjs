/**
 * Cutoffs for PlayCanvas: each splat's quad ends where its learned threshold says.
 *
 *     const entity = new pc.Entity();
 *     entity.addComponent('gsplat', { asset });
 *     await installCutoffs(app, entity);             // those that the PLY or SOG holds
 *     await installCutoffs(app, entity, { cutoffs }) // or Uint8Array: a code per row of the file
 *
 * A code c is the threshold 255^(c/256 - 1) of the falloff exp(-q/2), q the squared distance in
 * standard deviations; code 0 changes nothing. Codes travel in extra streams of the engine, and shader
 * chunks of `app.scene.gsplat.material` get one condition each, in GLSL or in WGSL. Other entities, and
 * a file without cutoffs, stay as they are.
 */
import * as pc from 'playcanvas';

const SUPPORTED = '2.20 to 2.23, WebGL 2 and WebGPU';
const pascal = (name) => name[0].toUpperCase() + name.slice(1);

const COLUMN = 'trunc_threshold';
const CODES = 'fragprune_codes'; // our own column, so that the engine moves it with the rows
const STREAM = 'fragpruneCutoff'; // codes of an entity's rows
const IMAGE = 'fragpruneCutoffImage'; // the same from a SOG's image, as red
const EXTRA = 'fragprune_cutoff'; // of a SOG's meta.json
const BUFFER = 'fragpruneCode'; // codes of all splats of the scene, in the engine's work buffer
const LIMIT = 'fragpruneLimit'; // squared radius of a splat's ellipse in units of gaussianUV

const LIMIT_PER_STEP = (Math.log(255) / 1024).toFixed(10); // the engine's kernel is exp(-4 A): A = Q / 8

// What differs between the languages of shaders: the engine's lines that change, and our own.
const GLSL = {
    modifier: `
void modifySplatCenter(inout vec3 center) {}
void modifySplatRotationScale(vec3 before, vec3 after, inout vec4 rotation, inout vec3 scale) {}
void modifySplatColor(vec3 center, inout vec4 color) {}
`,
    modifierStart: 'void modifySplatColor(vec3 center, inout vec4 color) {',
    ofImage: (texel) => `uint(${texel}.r * 255.0 + 0.5)`,
    kind: 'void',
    writeSplat: `
uint ${BUFFER} = 0u;
void writeSplat(vec3 center, vec4 rotation, vec3 scale, vec4 color) {
    engineWriteSplat(center, rotation, scale, color);
    write${pascal(BUFFER)}(uvec4(${BUFFER}, 0u, 0u, 0u));
}`,
    discard: ['if (A > 1.0)', `if (A > min(1.0, get${pascal(LIMIT)}()))`],
    // The engine has set uv to its own extent.
    clipCorner: `
void clipCorner(inout SplatCorner corner, float alpha) {
    engineClipCorner(corner, alpha);
    float limit = float(256u - load${pascal(BUFFER)}().r) * ${LIMIT_PER_STEP};
    float extent = max(abs(corner.uv.x), abs(corner.uv.y));
    float shrink = min(1.0, sqrt(limit) / max(extent, 1e-6));
    corner.offset *= shrink;
    corner.uv *= shrink;
    set${pascal(LIMIT)}(limit);
}`
};

const WGSL = {
    modifier: `
fn modifySplatCenter(center: ptr<function, vec3f>) {}
fn modifySplatRotationScale(before: vec3f, after: vec3f, rotation: ptr<function, vec4f>, scale: ptr<function, vec3f>) {}
fn modifySplatColor(center: vec3f, color: ptr<function, vec4f>) {}
`,
    modifierStart: 'fn modifySplatColor(center: vec3f, color: ptr<function, vec4f>) {',
    ofImage: (texel) => `u32(${texel}.r * 255.0 + 0.5)`,
    kind: 'fn',
    writeSplat: `
var<private> ${BUFFER}: u32 = 0u;
fn writeSplat(center: vec3f, rotation: vec4f, scale: vec3f, color: vec4f) {
    engineWriteSplat(center, rotation, scale, color);
    write${pascal(BUFFER)}(vec4u(${BUFFER}, 0u, 0u, 0u));
}`,
    discard: ['if (A > half(1.0))', `if (A > min(half(1.0), half(get${pascal(LIMIT)}())))`],
    clipCorner: `
fn clipCorner(corner: ptr<function, SplatCorner>, alpha: half) {
    engineClipCorner(corner, alpha);
    let extent = max(abs(f32(corner.uv.x)), abs(f32(corner.uv.y)));
    let shrink = min(1.0, sqrt(${LIMIT}Of()) / max(extent, 1e-6));
    corner.offset *= shrink;
    corner.uv *= half(shrink);
}`,
    // Of a splat, in the vertex stage and in the compute stage that projects for the GPU's sort. Shadows
    // have this chunk without the varying.
    modifySplatColor: `
#ifdef GSPLAT_USER_VARYINGS
fn ${LIMIT}Of() -> f32 { return f32(256u - load${pascal(BUFFER)}().r) * ${LIMIT_PER_STEP}; }
#endif
fn modifySplatColor(center: vec3f, color: ptr<function, vec4f>) {
    engineModifySplatColor(center, color);
#ifdef GSPLAT_USER_VARYINGS
    set${pascal(LIMIT)}(${LIMIT}Of());
#endif
}`,
    // The corner of a splat that was projected: what it carries is read before the corner is placed.
    corner: ['let cornerClipped = cornerUV * f32(clip);', `
#include "gsplatUserCacheReadVS"
    let cornerClipped = cornerUV * min(f32(clip), sqrt(output.user_${LIMIT}));`]
};

function fail(found, remedy) {
    return new Error(`fragprune: ${found} (PlayCanvas ${pc.version}; supported: ${SUPPORTED}). ${remedy}`);
}

/** Replace what occurs exactly once. */
function replaceOnce(text, pattern, replacement, where) {
    const count = text?.split(pattern).length - 1;
    if (count !== 1) {
        throw fail(`${where} has ${count || 'no'} places of "${pattern}", not one`, 'Use a supported engine.');
    }
    return text.replace(pattern, () => replacement);
}

/** Code of a threshold: the nearest step in Q = -2 ln threshold. */
export function encode(threshold) {
    if (!(threshold >= 0 && threshold <= 1)) throw new RangeError(`fragprune: threshold ${threshold}`);
    return Math.min(255, Math.max(0, Math.round(256 + (256 * Math.log(threshold)) / Math.log(255))));
}

/**
 * Let an entity's splats end at their cutoffs.
 *
 * @param {pc.AppBase} app - The application.
 * @param {pc.Entity} entity - With a gsplat component; its asset may still have to load.
 * @param {object} [options]
 * @param {Uint8Array} [options.cutoffs] - A code per row, in the order of the file; default: those
 * that the file holds, a PLY in its column trunc_threshold, a SOG in its extras.
 * @param {string} [options.modifier] - Your own work buffer modifier, if you have one, in the device's
 * language, GLSL or WGSL: a component takes one modifier, and this is where ours and yours become one.
 * @returns {Promise<boolean>} Whether there are cutoffs; if not, nothing is changed.
 */
export async function installCutoffs(app, entity, { cutoffs, modifier } = {}) {
    const component = entity.gsplat;
    if (!component) throw fail('the entity has no gsplat component', 'Add it first.');
    check(app, component);
    const asset = component.asset ? app.assets.get(component.asset) : null;
    if (asset && !asset.loaded) await load(app, asset, cutoffs);
    else if (cutoffs && isReordered(asset)) {
        throw fail('the asset has loaded, and the engine has reordered its rows',
            'Call installCutoffs before the asset loads, or load it with data: { reorder: false }.');
    }
    const resource = component.resource;
    if (!resource?.format?.addExtraStreams) {
        throw fail('the asset is not one splat file', 'Cutoffs of streamed LOD are not supported.');
    }
    const image = cutoffs ? null : await imageOf(asset, resource);
    const codes = image ? null : codesOf(resource, cutoffs);
    if (!image && !codes) return false;
    const language = languageOf(app);
    const code = image ? language.ofImage(`load${pascal(IMAGE)}()`) : `load${pascal(STREAM)}().r`;
    const start = language.modifierStart;
    const modified = replaceOnce(modifier ?? language.modifier, start, `${start}\n    ${BUFFER} = ${code};`, 'the modifier');
    installShaders(app);
    const [name, format] = image ? [IMAGE, pc.PIXELFORMAT_RGBA8] : [STREAM, pc.PIXELFORMAT_R8U];
    resource.format.addExtraStreams([{ name, format, storage: pc.GSPLAT_STREAM_INSTANCE }]);
    const texture = component.getInstanceTexture(name);
    if (!texture) throw fail('the engine gave no texture for codes', 'Enable the component first.');
    if (image) {
        const [have, want] = [image, texture].map(({ width, height }) => `${width}x${height}`);
        if (have !== want) throw fail(`an image of ${have} cutoffs for ${want} splats`, 'Write the SOG again.');
        texture.setSource(image);
    } else {
        texture.lock().fill(0).set(codes);
        texture.unlock();
    }
    component.setWorkBufferModifier({ [app.graphicsDevice.isWebGPU ? 'wgsl' : 'glsl']: modified });
    return true;
}

/** Refuse what cannot work, before anything is changed. */
function check(app, component) {
    const gsplat = app.scene.gsplat;
    const needed = {
        'scene.gsplat.material': gsplat?.material?.getShaderChunks,
        'scene.gsplat.varyings': gsplat?.varyings?.add,
        'scene.gsplat.format': gsplat?.format?.setWriteCode && gsplat.format.addExtraStreams,
        'gsplat.getInstanceTexture': component.getInstanceTexture,
        'gsplat.setWorkBufferModifier': component.setWorkBufferModifier,
        ShaderChunks: pc.ShaderChunks
    };
    const missing = Object.keys(needed).filter((name) => !needed[name]);
    if (missing.length) throw fail(`no ${missing.join(', ')}`, 'Use a supported engine.');
    const { isWebGL2, isWebGPU } = app.graphicsDevice;
    if (!isWebGL2 && !isWebGPU) throw fail('the device is neither', 'Create it with deviceTypes: ["webgpu", "webgl2"].');
    const bytes = app.graphicsDevice.wgpu?.limits.maxColorAttachmentBytesPerSample;
    if (bytes < 33 && gsplat.dataFormat === pc.GSPLATDATA_LARGE) {
        throw fail(`the device writes ${bytes} bytes at once, and large data with codes takes 33`,
            'Set app.scene.gsplat.dataFormat to GSPLATDATA_COMPACT.');
    }
    if (!component.unified) throw fail('the component has unified: false', 'Leave it at its default, true.');
}

const isPly = (asset) => /\.ply($|\?)/i.test(asset.file?.filename || asset.file?.url || '');

function isReordered(asset) {
    return !!asset && isPly(asset) && !asset.resource?.gsplatData?.isCompressed && (asset.data?.reorder ?? true);
}

/** Wait for the asset. Codes become a column of the file's rows before the engine reorders them. */
function load(app, asset, cutoffs) {
    return new Promise((resolve, reject) => {
        asset.once('error', (error) => reject(new Error(`fragprune: ${asset.name}: ${error}`)));
        asset.once('load:data', (data) => {
            if (!cutoffs || data.isCompressed) return; // the engine keeps the order of compressed rows
            if (data.numSplats === cutoffs.length) data.addProp(CODES, cutoffs.slice());
            else reject(wrongCount(cutoffs.length, data.numSplats));
        });
        asset.ready(() => resolve());
        app.assets.load(asset);
    });
}

function wrongCount(codes, rows) {
    return fail(`${codes} cutoffs for ${rows} splats`, 'Pass those of this very file.');
}

/** Codes in the engine's order of rows; null if there are none. */
function codesOf(resource, cutoffs) {
    const data = resource.gsplatData;
    const column = (name) => (data?.elements ? data.getProp(name) : undefined);
    if (!cutoffs && !column(COLUMN)) return null;
    const codes = cutoffs ? column(CODES) ?? cutoffs : Uint8Array.from(column(COLUMN), encode);
    if (!(codes instanceof Uint8Array)) throw fail('cutoffs are not a Uint8Array', 'Pass codes of 8 bits.');
    if (codes.length !== resource.numSplats) throw wrongCount(codes.length, resource.numSplats);
    return codes;
}

/** The image of codes of a SOG, a texel for each row; undefined if it has none. */
async function imageOf(asset, resource) {
    const file = resource.gsplatData?.meta?.extras?.[EXTRA]?.files?.[0];
    if (!file || !asset) return undefined;
    const url = new URL(asset.getFileUrl(), location.href);
    const bundle = !/\.json$/i.test(url.pathname);
    const answer = await fetch(bundle ? url : new URL(file, url));
    if (!answer.ok) throw fail(`${answer.url}: ${answer.status}`, 'Serve the whole model.');
    const bytes = await answer.arrayBuffer();
    const image = new Blob([bundle ? await unzipped(bytes, file) : bytes]);
    return createImageBitmap(image, { premultiplyAlpha: 'none', colorSpaceConversion: 'none' });
}

/** One file of a zip, found in the directory at its end. */
async function unzipped(bytes, wanted) {
    const view = new DataView(bytes);
    const end = view.byteLength - 22;
    let at = view.getUint32(end + 16, true);
    for (let left = view.getUint16(end + 10, true); left > 0; left--) {
        const [name, extra, comment] = [28, 30, 32].map((offset) => view.getUint16(at + offset, true));
        if (new TextDecoder().decode(new Uint8Array(bytes, at + 46, name)) === wanted) {
            const local = view.getUint32(at + 42, true);
            const from = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
            const packed = new Blob([new Uint8Array(bytes, from, view.getUint32(at + 20, true))]);
            if (view.getUint16(at + 10, true) === 0) return packed;
            return new Response(packed.stream().pipeThrough(new DecompressionStream('deflate-raw'))).blob();
        }
        at += 46 + name + extra + comment;
    }
    throw fail(`the SOG has no ${wanted}`, 'Write it again.');
}

const languageOf = (app) => (app.graphicsDevice.isWebGPU ? WGSL : GLSL);

const installed = new WeakSet();

/** Once per scene: codes in the work buffer, and quads that end at the cutoff. */
function installShaders(app) {
    const { material, format, varyings } = app.scene.gsplat;
    if (installed.has(material)) return;
    const language = languageOf(app);
    const kind = language === WGSL ? pc.SHADERLANGUAGE_WGSL : pc.SHADERLANGUAGE_GLSL;
    const chunks = material.getShaderChunks(kind);
    const engine = pc.ShaderChunks.get(app.graphicsDevice, kind);
    const source = (chunk) => chunks.get(chunk) ?? engine.get(chunk);
    // The engine's function gets another name, and ours calls it.
    const wrapped = (text, name, where) =>
        replaceOnce(text, `${language.kind} ${name}(`, `${language.kind} engine${pascal(name)}(`, where) + language[name];

    // Splats of other entities get code 0 here, which changes nothing.
    const write = wrapped(format.getWriteCode(), 'writeSplat', 'the write code');
    const changed = {
        gsplatCommonVS: wrapped(source('gsplatCommonVS'), 'clipCorner', 'gsplatCommonVS'),
        gsplatPS: replaceOnce(source('gsplatPS'), ...language.discard, 'gsplatPS')
    };
    if (language === WGSL) {
        changed.gsplatModifyVS = wrapped(source('gsplatModifyVS'), 'modifySplatColor', 'gsplatModifyVS');
        changed.gsplatHybridVS = replaceOnce(source('gsplatHybridVS'), ...language.corner, 'gsplatHybridVS');
    }

    format.addExtraStreams([{ name: BUFFER, format: pc.PIXELFORMAT_R8U }]);
    format.setWriteCode(write, write);
    varyings.add([{ name: LIMIT, type: pc.TYPE_FLOAT32, components: 1 }]);
    for (const [chunk, text] of Object.entries(changed)) chunks.set(chunk, text);
    material.update();
    installed.add(material);
}
