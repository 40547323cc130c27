// The shaders. A Gaussian is projected once a frame, by one pixel of a texture; the four corners of
// its quad read it there. Rules and constants are those of the engines: see docs/reference.

export const ROW = 2048; // texels in a row of the tables of Gaussians

const HEAD = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
`;

export const WHOLE = `${HEAD}
void main() { // one triangle over all of it
    gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0);
}`;

// Half floats of a Gaussian's harmonics lie one after another, colour by colour of a coefficient.
function harmonics(degree) {
    const count = 3 * (degree + 1) ** 2;
    const lines = [];
    for (let texel = 0; texel * 8 < count; texel++) {
        lines.push(`uvec4 t${texel} = look(u_harmonics, row * ${Math.ceil(count / 8)} + ${texel});`);
        for (const [i, part] of ["x", "y", "z", "w"].entries())
            if (texel * 8 + i * 2 < count)
                lines.push(`vec2 h${texel * 4 + i} = unpackHalf2x16(t${texel}.${part});`);
    }
    const half = n => `h${n >> 1}.${n & 1 ? "y" : "x"}`;
    const coefficient = k => `vec3(${half(3 * k)}, ${half(3 * k + 1)}, ${half(3 * k + 2)})`;
    const basis = [
        "0.28209479177387814",
        "-0.4886025119029199 * d.y", "0.4886025119029199 * d.z", "-0.4886025119029199 * d.x",
        "1.0925484305920792 * d.x * d.y", "-1.0925484305920792 * d.y * d.z",
        "0.31539156525252005 * (2.0 * dd.z - dd.x - dd.y)",
        "-1.0925484305920792 * d.x * d.z", "0.5462742152960396 * (dd.x - dd.y)",
        "-0.5900435899266435 * d.y * (3.0 * dd.x - dd.y)",
        "2.890611442640554 * d.x * d.y * d.z",
        "-0.4570457994644658 * d.y * (4.0 * dd.z - dd.x - dd.y)",
        "0.3731763325901154 * d.z * (2.0 * dd.z - 3.0 * dd.x - 3.0 * dd.y)",
        "-0.4570457994644658 * d.x * (4.0 * dd.z - dd.x - dd.y)",
        "1.445305721320277 * d.z * (dd.x - dd.y)",
        "-0.5900435899266435 * d.x * (dd.x - 3.0 * dd.y)",
    ];
    const terms = basis.slice(0, (degree + 1) ** 2)
        .map((each, k) => `rgb += (${each}) * ${coefficient(k)};`);
    return [...lines, "vec3 rgb = vec3(0.5);", ...terms].join("\n    ");
}

export const PROJECT = degree => `${HEAD}
uniform usampler2D u_geometry, u_harmonics, u_order;
uniform int u_count;            // Gaussians in the order
uniform mat3 u_rotation;        // world to camera: x right, y down, z forward
uniform vec3 u_position;        // of the camera
uniform vec4 u_lens;            // fx, fy, cx, cy, pixels
uniform vec2 u_size;            // of the picture, pixels
uniform vec2 u_sides;           // first column and the one past the last that are drawn
uniform vec2 u_scales;          // least and largest logarithm of a scale
uniform bool u_truncated, u_fixed;
layout(location = 0) out uvec4 shape; // centre; long axis: one standard deviation, pixels
layout(location = 1) out uvec4 paint; // short axis over long one; cutoff q, negative: not drawn;
                                      // red, green; blue, opacity

uvec4 look(usampler2D table, int index) {
    return texelFetch(table, ivec2(index % ${ROW}, index / ${ROW}), 0);
}

void main() {
    int place = int(gl_FragCoord.y) * ${ROW} + int(gl_FragCoord.x);
    shape = uvec4(0u);
    paint = uvec4(0u, floatBitsToUint(-1.0), 0u, 0u);
    if (place >= u_count) return;
    int row = int(look(u_order, place).x);
    uvec4 first = look(u_geometry, 2 * row), second = look(u_geometry, 2 * row + 1);

    vec3 mean = uintBitsToFloat(first.xyz);
    vec3 p = u_rotation * (mean - u_position);
    if (p.z <= 0.2) return;
    vec2 limits = unpackUnorm2x16(first.w); // opacity; cutoff, 1 where the Gaussian has none
    float opacity = limits.x;
    float cutoff = 2.0 * log(255.0 * opacity);
    if (u_truncated) cutoff = min(cutoff, ${2 * Math.log(255)} * limits.y);
    if (u_fixed) cutoff = 8.0;
    if (!(cutoff >= 0.0)) return;

    vec4 r = vec4(unpackSnorm2x16(second.x), unpackSnorm2x16(second.y)); // w x y z
    vec3 s = exp(mix(vec3(u_scales.x), vec3(u_scales.y),
                     vec3(unpackUnorm2x16(second.z), unpackUnorm2x16(second.w).x)));
    mat3 turn = mat3( // column by column
        1.0 - 2.0 * (r.z * r.z + r.w * r.w), 2.0 * (r.y * r.z + r.x * r.w), 2.0 * (r.y * r.w - r.x * r.z),
        2.0 * (r.y * r.z - r.x * r.w), 1.0 - 2.0 * (r.y * r.y + r.w * r.w), 2.0 * (r.z * r.w + r.x * r.y),
        2.0 * (r.y * r.w + r.x * r.z), 2.0 * (r.z * r.w - r.x * r.y), 1.0 - 2.0 * (r.y * r.y + r.z * r.z));
    mat3 axes = u_rotation * mat3(turn[0] * s.x, turn[1] * s.y, turn[2] * s.z);
    vec2 slope = clamp(p.xy / p.z, -0.65 * u_size / u_lens.xy, 0.65 * u_size / u_lens.xy);
    vec3 across = u_lens.x / p.z * (transpose(axes) * vec3(1.0, 0.0, -slope.x));
    vec3 down = u_lens.y / p.z * (transpose(axes) * vec3(0.0, 1.0, -slope.y));
    float xx = dot(across, across) + 0.3, xy = dot(across, down), yy = dot(down, down) + 0.3;

    vec3 area = cross(across, down); // no difference of large numbers: thin ones stay thin
    float det = dot(area, area) + 0.3 * (xx + yy) - 0.09;
    float half_gap = 0.5 * (xx - yy), root = length(vec2(half_gap, xy));
    float long2 = 0.5 * (xx + yy) + root;
    vec2 along = half_gap > 0.0 ? vec2(half_gap + root, xy) : vec2(xy, root - half_gap);
    along = dot(along, along) > 0.0 ? normalize(along) : vec2(1.0, 0.0);
    vec2 centre = u_lens.xy * p.xy / p.z + u_lens.zw;

    vec2 reach = sqrt(cutoff * vec2(xx, yy)); // of the ellipse
    if (centre.x + reach.x < u_sides.x || centre.x - reach.x > u_sides.y) return;
    if (centre.y + reach.y < 0.0 || centre.y - reach.y > u_size.y) return;

    vec3 d = normalize(mean - u_position), dd = d * d;
    ${harmonics(degree)}
    rgb = max(rgb, 0.0);
    shape = floatBitsToUint(vec4(centre, along * sqrt(long2)));
    paint = uvec4(floatBitsToUint(vec2(sqrt(det) / long2, cutoff)),
                  packHalf2x16(rgb.xy), packHalf2x16(vec2(rgb.z, opacity)));
}`;

export const QUADS = `${HEAD}
uniform usampler2D u_shape, u_paint;
uniform int u_first;
uniform vec2 u_size;
uniform float u_large;      // pixels
flat out vec3 v_place;      // centre, pixels from below; cutoff
flat out vec4 v_axes;       // from pixels to standard deviations
flat out vec4 v_color;

void main() {
    int place = u_first + (gl_VertexID >> 3), corner = gl_VertexID & 7;
    ivec2 texel = ivec2(place % ${ROW}, place / ${ROW});
    uvec4 paint = texelFetch(u_paint, texel, 0);
    float cutoff = uintBitsToFloat(paint.y);
    if (cutoff < 0.0) {
        gl_Position = vec4(0.0, 0.0, 2.0, 1.0); // all corners: draws nothing
        return;
    }
    vec4 shape = uintBitsToFloat(texelFetch(u_shape, texel, 0));
    float ratio = uintBitsToFloat(paint.x);
    vec2 other = vec2(-shape.w, shape.z) * ratio;
    // An octagon, a sixth smaller than the quad; of a tiny one the quad: corners fall together.
    float side = 4.0 * cutoff * ratio * dot(shape.zw, shape.zw) > u_large ? 0.41421356 : 1.0;
    bool upright = ((corner + 1) & 2) == 0; // on the octagon's left or right side
    vec2 signs = vec2(((corner + 2) & 7) < 4 ? 1.0 : -1.0, corner < 4 ? 1.0 : -1.0);
    vec2 sigmas = sqrt(cutoff) * signs * (upright ? vec2(1.0, side) : vec2(side, 1.0));
    vec2 at = shape.xy + sigmas.x * shape.zw + sigmas.y * other;
    v_place = vec3(shape.x, u_size.y - shape.y, cutoff);
    v_axes = vec4(shape.zw / dot(shape.zw, shape.zw), other / dot(other, other)) * vec2(1.0, -1.0).xyxy;
    v_color = vec4(unpackHalf2x16(paint.z), unpackHalf2x16(paint.w));
    gl_Position = vec4(2.0 * at / u_size - 1.0, 0.0, 1.0);
    gl_Position.y = -gl_Position.y;
}`;

// Front to back: colour times the light that is left, which alpha holds. Distances are taken anew at
// each pixel, because corners are rounded to fractions of a pixel, and what they carry with them.
export const FRAGMENT = counted => `${HEAD}
flat in vec3 v_place;
flat in vec4 v_axes, v_color;
layout(location = 0) out vec4 color;
${counted ? "layout(location = 1) out vec4 counts;" : ""}

void main() {
    vec2 from = gl_FragCoord.xy - v_place.xy;
    vec2 sigmas = vec2(dot(from, v_axes.xy), dot(from, v_axes.zw));
    float q = dot(sigmas, sigmas);
    ${counted ? "counts = vec4(1.0, q <= v_place.z ? 1.0 : 0.0, 0.0, 0.0);" : ""}
    if (q > v_place.z) ${counted ? "{ color = vec4(0.0); return; }" : "discard;"}
    float alpha = min(0.99, v_color.a * exp(-0.5 * q));
    color = vec4(v_color.rgb * alpha, alpha);
}`;

// Marks, in the depth buffer, pixels with too little light left to see, or to go on by the model's stop.
export const MARK = `${HEAD}
uniform sampler2D u_color;
uniform float u_least;
void main() {
    if (texelFetch(u_color, ivec2(gl_FragCoord.xy), 0).a >= u_least) discard;
}`;

export const SUM = side => `${HEAD}
uniform sampler2D u_counts;
uniform ivec2 u_sides;
out vec4 total;
void main() {
    ivec2 size = textureSize(u_counts, 0), start = ivec2(gl_FragCoord.xy) * ${side};
    total = vec4(0.0);
    for (int y = start.y; y < min(start.y + ${side}, size.y); y++)
        for (int x = max(start.x, u_sides.x); x < min(start.x + ${side}, u_sides.y); x++)
            total += texelFetch(u_counts, ivec2(x, y), 0);
}`;

export const SHOW = `${HEAD}
uniform sampler2D u_color, u_counts;
uniform vec3 u_background;
uniform float u_limit;      // counts at the top of the scale; 0 shows the picture
uniform int u_channel;      // of the counts
out vec4 color;
vec3 inferno(float t) {     // a polynomial fit of matplotlib's
    const vec3 c0 = vec3(0.0002189403691192265, 0.001651004631001012, -0.01948089843709184);
    const vec3 c1 = vec3(0.1065134194856116, 0.5639564367884091, 3.932712388889277);
    const vec3 c2 = vec3(11.60249308247187, -3.972853965665698, -15.9423941062914);
    const vec3 c3 = vec3(-41.70399613139459, 17.43639888205313, 44.35414519872813);
    const vec3 c4 = vec3(77.162935699427, -33.40235894210092, -81.80730925738993);
    const vec3 c5 = vec3(-71.31942824499214, 32.62606426397723, 73.20951985803202);
    const vec3 c6 = vec3(25.13112622477341, -12.24266895238567, -23.07032500287172);
    return c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * (c5 + t * c6)))));
}
void main() {
    ivec2 here = ivec2(gl_FragCoord.xy);
    if (u_limit > 0.0) {
        vec4 counts = texelFetch(u_counts, here, 0);
        color = vec4(inferno(min(1.0, counts[u_channel] / u_limit)), 1.0);
    } else {
        vec4 drawn = texelFetch(u_color, here, 0);
        color = vec4(drawn.rgb + drawn.a * u_background, 1.0);
    }
}`;
