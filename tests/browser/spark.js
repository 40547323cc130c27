// One splat in Spark. options: model, width, height, camera {matrix, fovY}; bridge; cutoffs; spark,
// mesh: more of theirs; plain: draw as the 3DGS rasterizer does as far as Spark's own settings go;
// second: a place for the same splat without cutoffs, where "hidden" says which of the two is there
// instead of at the origin, and "first" whether it is made first.
import * as THREE from 'three';
import { SparkRenderer, SplatMesh } from '@sparkjsdev/spark';

export async function start(canvas, options) {
    const { width, height, camera } = options;
    const renderer = new THREE.WebGLRenderer({ canvas, antialias: false });
    renderer.setPixelRatio(1);
    renderer.setSize(width, height, false);
    renderer.setClearColor(0x000000, 1);
    const eye = new THREE.PerspectiveCamera(camera.fovY, width / height, 0.01, 1000);
    eye.matrixAutoUpdate = false;
    eye.matrix.fromArray(camera.matrix);
    eye.updateMatrixWorld(true);

    const scene = new THREE.Scene();
    const plain = { preBlurAmount: 0.3, blurAmount: 0, sortRadial: false, accumExtSplats: true, minAlpha: 1 / 255 };
    const spark = new SparkRenderer({ renderer, ...(options.plain ? plain : {}), ...options.spark });
    scene.add(spark);
    const fileBytes = await (await fetch(options.model)).arrayBuffer();
    const make = (...place) => {
        const made = new SplatMesh({ fileBytes, fileName: options.model, extSplats: options.plain, ...options.mesh });
        made.position.set(...place);
        scene.add(made);
        return made;
    };
    const places = { cut: [0, 0, 0], second: [0, 0, 0] };
    places[options.hidden] = options.second;
    let other = options.second && options.first ? make(...places.second) : null;
    const mesh = make(...places.cut);
    if (options.second && !options.first) other = make(...places.second);
    if (options.bridge) {
        const { installCutoffs, readCutoffs } = await import('fragprune-spark');
        const { cutoffs: given } = options;
        const cutoffs = given ? Array.isArray(given) ? Uint8Array.from(given) : given : readCutoffs(fileBytes);
        await installCutoffs(spark, mesh, { cutoffs });
    }
    await Promise.all([mesh.initialized, other?.initialized]);

    const frame = () => new Promise((resolve) => requestAnimationFrame(resolve));
    const draw = () => renderer.render(scene, eye);
    const wanted = mesh.numSplats + (other?.numSplats ?? 0);
    for (let settled = 0; settled < 3;) {
        draw();
        await frame();
        const sorted = !spark.sorting && !spark.sortDirty && spark.display === spark.current;
        settled = sorted && spark.activeSplats > 0 && spark.display.numSplats >= wanted ? settled + 1 : 0;
    }

    const gl = renderer.getContext();
    return {
        spark,
        mesh,
        picture() {
            draw();
            const pixels = new Uint8Array(width * height * 4);
            gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
            return pixels;
        },
        quads() { // every fragment adds 1: red 1 and alpha 0 are blended as a sum
            const held = spark.material.fragmentShader;
            spark.material.fragmentShader = 'precision highp float; out vec4 sum; void main() { sum = vec4(1.0, 0.0, 0.0, 0.0); }';
            spark.material.needsUpdate = true;
            const target = new THREE.WebGLRenderTarget(width, height, { type: THREE.FloatType });
            renderer.setClearColor(0x000000, 0);
            renderer.setRenderTarget(target);
            draw();
            const sums = new Float32Array(width * height * 4);
            renderer.readRenderTargetPixels(target, 0, 0, width, height, sums);
            renderer.setRenderTarget(null);
            renderer.setClearColor(0x000000, 1);
            target.dispose();
            spark.material.fragmentShader = held;
            spark.material.needsUpdate = true;
            let [pixels, peak] = [0, 0];
            for (let i = 0; i < sums.length; i += 4) {
                pixels += sums[i];
                peak = Math.max(peak, sums[i]);
            }
            return { pixels, peak };
        },
        async frames(count) {
            const times = [];
            for (let i = 0; i < count + 1; i++) {
                await frame();
                const from = performance.now();
                draw();
                gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
                times.push(performance.now() - from);
            }
            return times.slice(1);
        }
    };
}
