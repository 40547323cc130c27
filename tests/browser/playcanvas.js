// One splat in PlayCanvas. options: model, width, height, camera {matrix, fovY}; webgpu: a device of that
// kind, not WebGL 2; sorting: "cpu" there, too; bytes: a limit of that device; bridge; cutoffs; modifier, chunks: shaders of the page's own; component, data: of the component and the asset; late:
// the asset has loaded before the bridge comes; plain: draw as the 3DGS rasterizer does as far as the
// engine's own settings go; second: a place for the same splat without cutoffs, where "hidden" says
// which of the two is there instead of at the origin, and "first" whether it is made first.
import * as pc from 'playcanvas';

// The kernel that fades to 0 at the quad's edge, the one that does not, and a fragment that adds 1: red 1
// and alpha 0 are blended as a sum.
const GLSL = {
    faded: '(exp(x * -4.0) - EXP4) * INV_EXP4',
    kernel: 'exp(x * -4.0)',
    one: 'void main(void) { gl_FragColor = vec4(1.0, 0.0, 0.0, 0.0); }'
};
const WGSL = {
    faded: '(exp(x * half(-4.0)) - EXP4) * INV_EXP4',
    kernel: 'exp(x * half(-4.0))',
    one: `
    varying gaussianUV: half2;
    @fragment
    fn fragmentMain(input: FragmentInput) -> FragmentOutput {
        var output: FragmentOutput;
        output.color = vec4f(1.0, 0.0, 0.0, 0.0);
        return output;
    }`
};

export async function start(canvas, options) {
    const { width, height, camera } = options;
    Object.assign(canvas, { width, height });
    const deviceTypes = [options.webgpu ? 'webgpu' : 'webgl2'];
    const device = await pc.createGraphicsDevice(canvas, { deviceTypes, antialias: false, alpha: false });
    if (device.isWebGPU !== !!options.webgpu) throw new Error(`no ${deviceTypes}`);
    const [shaders, language] = options.webgpu ? [WGSL, pc.SHADERLANGUAGE_WGSL] : [GLSL, pc.SHADERLANGUAGE_GLSL];
    if (options.bytes) Object.defineProperty(device.wgpu, 'limits', { value: { maxColorAttachmentBytesPerSample: options.bytes } });
    const set = new pc.AppOptions();
    set.graphicsDevice = device;
    set.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem];
    set.resourceHandlers = [pc.GSplatHandler, pc.TextureHandler];
    const app = new pc.AppBase(canvas);
    app.init(set);
    app.setCanvasFillMode(pc.FILLMODE_NONE);
    app.setCanvasResolution(pc.RESOLUTION_FIXED, width, height);
    app.start();

    const material = app.scene.gsplat.material;
    const chunks = material.getShaderChunks(language);
    for (const [name, text] of Object.entries(options.chunks ?? {})) chunks.set(name, text);
    if (options.sorting === 'cpu') app.scene.gsplat.renderer = pc.GSPLAT_RENDERER_RASTER_CPU_SORT;
    if (options.plain) {
        app.scene.gsplat.dataFormat = pc.GSPLATDATA_LARGE;
        app.scene.gsplat.minPixelSize = 0;
    }

    const eye = new pc.Entity();
    eye.addComponent('camera', { clearColor: new pc.Color(0, 0, 0, 1), fov: camera.fovY, nearClip: 0.01, farClip: 1000 });
    app.root.addChild(eye);
    const pose = new pc.Mat4().set(camera.matrix);
    eye.setPosition(pose.getTranslation());
    eye.setRotation(new pc.Quat().setFromMat4(pose));

    const { installCutoffs } = options.bridge ? await import('fragprune-playcanvas') : {};
    const asset = new pc.Asset('model', 'gsplat', { url: options.model }, options.data ?? {});
    app.assets.add(asset);
    const loaded = new Promise((resolve, reject) => {
        asset.ready(resolve);
        asset.once('error', reject);
    });
    if (options.late) {
        app.assets.load(asset);
        await loaded;
    }
    const make = (...place) => {
        const made = new pc.Entity();
        made.addComponent('gsplat', { ...options.component, asset });
        made.setLocalPosition(...place);
        app.root.addChild(made);
        return made;
    };
    const places = { cut: [0, 0, 0], second: [0, 0, 0] };
    places[options.hidden] = options.second;
    if (options.second && options.first) make(...places.second);
    const entity = make(...places.cut);
    if (options.second && !options.first) make(...places.second);
    if (options.bridge) {
        const given = options.cutoffs ? { cutoffs: Uint8Array.from(options.cutoffs) } : {};
        await installCutoffs(app, entity, { ...given, modifier: options.modifier });
    }
    await loaded;
    if (options.plain) {
        const engine = pc.ShaderChunks.get(device, language);
        const text = chunks.get('gsplatPS') ?? engine.get('gsplatPS');
        if (!text.includes(shaders.faded)) throw new Error('another kernel');
        chunks.set('gsplatPS', text.replace(shaders.faded, shaders.kernel));
        material.update();
    }

    const gl = device.gl;
    const frame = () => new Promise((resolve) => {
        app.once('frameend', resolve);
        app.renderNextFrame = true;
    });
    const ready = new Promise((resolve) => {
        app.systems.gsplat.on('frame:ready', (_camera, _layer, done, loading) => done && loading === 0 && resolve());
    });
    await ready;
    app.autoRender = false; // other pages are measured meanwhile
    for (let i = 0; i < 3; i++) await frame();

    return {
        app,
        async picture() {
            await frame();
            if (options.webgpu) return copied(canvas);
            const pixels = new Uint8Array(width * height * 4);
            gl.bindFramebuffer(gl.FRAMEBUFFER, null);
            gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
            return pixels;
        },
        async quads() {
            const held = chunks.get('gsplatPS');
            chunks.set('gsplatPS', shaders.one);
            material.update();
            const texture = new pc.Texture(device, { width, height, format: pc.PIXELFORMAT_RGBA32F, mipmaps: false });
            const renderTarget = new pc.RenderTarget({ colorBuffer: texture, depth: true });
            eye.camera.clearColor = new pc.Color(0, 0, 0, 0);
            eye.camera.renderTarget = renderTarget;
            for (let i = 0; i < 3; i++) await frame();
            const sums = await texture.read(0, 0, width, height, { renderTarget, immediate: true });
            eye.camera.renderTarget = null;
            if (held) chunks.set('gsplatPS', held); else chunks.delete('gsplatPS');
            material.update();
            return total(sums);
        },
        async frames(count) {
            const times = [];
            let from;
            const began = () => { from = performance.now(); };
            app.on('framerender', began);
            for (let i = 0; i < count + 1; i++) {
                await frame();
                if (options.webgpu) await device.wgpu.queue.onSubmittedWorkDone();
                else gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
                times.push(performance.now() - from);
            }
            app.off('framerender', began);
            return times.slice(1);
        }
    };
}

// What a canvas shows, as WebGL's readPixels gives it: bottom row first.
function copied(canvas) {
    const { width, height } = canvas;
    const context = new OffscreenCanvas(width, height).getContext('2d');
    context.setTransform(1, 0, 0, -1, 0, height);
    context.drawImage(canvas, 0, 0);
    return context.getImageData(0, 0, width, height).data;
}

function total(sums) {
    let [pixels, peak] = [0, 0];
    for (let i = 0; i < sums.length; i += 4) {
        pixels += sums[i];
        peak = Math.max(peak, sums[i]);
    }
    return { pixels, peak };
}
