// What a page holds itself: bytes as text, and the tables that packing.py has made small.

const DIGITS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz!#$%.()*+-;,=>?@^_`{|}~";

// The bytes of a text of five digits for each four.
export function bytesOf(text) {
    const values = new Uint8Array(128);
    for (let i = 0; i < 85; i++) values[DIGITS.charCodeAt(i)] = i;
    const words = Math.ceil(text.length / 5), bytes = new DataView(new ArrayBuffer(words * 4));
    const padded = text.padEnd(words * 5, "~");
    for (let i = 0, at = 0; i < words; i++) {
        let word = 0;
        for (let k = 0; k < 5; k++) word = word * 85 + values[padded.charCodeAt(at++)];
        bytes.setUint32(i * 4, word);
    }
    return new Uint8Array(bytes.buffer, 0, Math.floor(text.length * 4 / 5));
}

// Tables as packing.py writes them.
export async function expanded(packed, { gaussians: count, degree, bits, rows }) {
    const inflated = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const inflating = new Response(inflated).arrayBuffer();
    const bytes = new Uint8Array(await inflating.catch(() => { throw new Error("The model in this page is damaged: make it again."); }));
    const coefficients = 3 * (degree + 1) ** 2, width = Math.ceil(coefficients / 8) * 8;
    const buffer = new ArrayBuffer(count * (32 + width * 2));
    const means = new Float32Array(buffer, 0, count * 8), words = new Uint16Array(buffer);
    let at = 0;
    const plane = (length = count) => bytes.subarray(at, at += length);
    const numbers = () => {
        const [a, b, c, d] = [plane(), plane(), plane(), plane()];
        return i => a[i] | b[i] << 8 | c[i] << 16 | d[i] << 24;
    };
    const book = () => {
        const codes = plane(512);
        return Uint16Array.from({ length: 256 }, (_, i) => codes[2 * i] | codes[2 * i + 1] << 8);
    };

    for (let axis = 0; axis < 3; axis++) {
        const step = numbers(), unit = 2 ** -bits;
        for (let i = 0, sum = 0; i < count; i++) {
            const coded = step(i);
            sum += (coded >>> 1) ^ -(coded & 1);
            means[i * 8 + axis] = sum * unit;
        }
    }

    const lower = [plane(), plane(), plane()], upper = plane();
    for (let i = 0; i < count; i++) {
        const largest = upper[i] >> 6;
        let left = 1;
        for (let k = 0, place = i * 16 + 8; k < 3; k++, place++) {
            if (k === largest) place++;
            const flags = upper[i] >> (2 * k), share = (lower[k][i] | (flags & 2) << 7) * Math.SQRT1_2 / 511;
            words[place] = Math.round(share * 32767) * (flags & 1 ? -1 : 1);
            left -= share * share;
        }
        words[i * 16 + 8 + largest] = Math.round(Math.sqrt(Math.max(0, left)) * 32767);
    }

    // Columns of 16-bit words from one to another, in a table so wide; shared: of the different rows.
    const columns = (from, to, start, stride, shared = false) => {
        const meant = book(), row = shared && rows < count ? numbers() : i => i;
        for (let column = from; column < to; column++) {
            const codes = plane(shared ? rows : count);
            for (let i = 0, place = start + column; i < count; i++, place += stride) words[place] = meant[codes[row(i)]];
        }
    };
    columns(6, 7, 0, 16);
    columns(7, 8, 0, 16);
    columns(12, 15, 0, 16);
    columns(0, 3, count * 16, width);
    columns(3, coefficients, count * 16, width, true);
    if (at !== bytes.length) throw new Error(`${bytes.length} bytes of a model where ${at} belong: make the page again.`);
    return buffer;
}
