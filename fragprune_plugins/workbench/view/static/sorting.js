// Runs in a worker: what may be seen from a camera, front to back.

export function sorting() {
    let means, reaches, keys, rows, keys2, rows2;
    const LEVELS = 4096, TOP = LEVELS * LEVELS - 1;
    const counts = [new Uint32Array(LEVELS), new Uint32Array(LEVELS)];

    // Rows of Gaussians that may reach into the picture, nearest first; equal ones as in the file.
    function sort({ rotation: m, position: c, width, height, fx, fy, cx, cy }) {
        const slopes = [ // the picture's edges at depth 1, and how fast distance to them grows
            [-cx / fx, (width - cx) / fx], [-cy / fy, (height - cy) / fy],
        ].map(([low, high]) => [low, high, Math.hypot(1, low), Math.hypot(1, high)]);
        const [[left, right, leftRoot, rightRoot], [top, bottom, topRoot, bottomRoot]] = slopes;
        const wider = Math.max(0.01, 6 / Math.min(fx, fy)); // the dilation, in small pictures too
        let count = 0, nearest = Infinity, farthest = 0;
        const depths = new Float32Array(keys2.buffer);
        for (let i = 0, j = 0; i < reaches.length; i++, j += 3) {
            const x = means[j] - c[0], y = means[j + 1] - c[1], z = means[j + 2] - c[2];
            const depth = m[6] * x + m[7] * y + m[8] * z;
            if (depth <= 0.2) continue;
            const reach = reaches[i];
            // Close to the camera the projection is steeper than the sphere around a Gaussian.
            if (depth > 4 * reach) {
                const margin = 1.5 * reach + wider * depth;
                const right_ = m[0] * x + m[1] * y + m[2] * z;
                if (left * depth - right_ > margin * leftRoot) continue;
                if (right_ - right * depth > margin * rightRoot) continue;
                const down = m[3] * x + m[4] * y + m[5] * z;
                if (top * depth - down > margin * topRoot) continue;
                if (down - bottom * depth > margin * bottomRoot) continue;
            }
            if (depth < nearest) nearest = depth;
            if (depth > farthest) farthest = depth;
            depths[count] = depth;
            rows2[count++] = i;
        }
        const scale = farthest > nearest ? TOP / (farthest - nearest) : 0;
        for (const each of counts) each.fill(0);
        for (let i = 0; i < count; i++) {
            const key = (depths[i] - nearest) * scale;
            keys[i] = key;
            counts[0][keys[i] & (LEVELS - 1)]++;
            counts[1][keys[i] >>> 12]++;
        }
        for (const each of counts)
            for (let i = 0, sum = 0; i < LEVELS; i++) [each[i], sum] = [sum, sum + each[i]];
        for (let i = 0; i < count; i++) {
            const to = counts[0][keys[i] & (LEVELS - 1)]++;
            keys2[to] = keys[i];
            rows[to] = rows2[i];
        }
        const sorted = new Uint32Array(count);
        for (let i = 0; i < count; i++) sorted[counts[1][keys2[i] >>> 12]++] = rows[i];
        return sorted;
    }

    self.onmessage = ({ data }) => {
        if (data.means) {
            ({ means, reaches } = data);
            [keys, rows, keys2, rows2] = [0, 0, 0, 0].map(() => new Uint32Array(reaches.length));
            return;
        }
        const started = performance.now();
        const order = sort(data.camera);
        const milliseconds = performance.now() - started;
        self.postMessage({ order, milliseconds }, [order.buffer]);
    };
}
