// What is under a point of the screen: the scene's Gaussians, unpacked once more from the SOG file, and the place along a ray where
// half of the light is gone (the same rule as dgtr's maps of heights).

// Stored entries of a zip, by name.
function unzip(bytes) {
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    const end = bytes.length - 22; // no comment: dgtr wrote it
    const entries = {};
    let at = view.getUint32(end + 16, true);
    for (let n = view.getUint16(end + 10, true); n > 0; n--) {
        const size = view.getUint32(at + 20, true);
        const [name, extra, comment] = [28, 30, 32].map((o) => view.getUint16(at + o, true));
        const local = view.getUint32(at + 42, true);
        const start = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
        const text = new TextDecoder().decode(bytes.subarray(at + 46, at + 46 + name));
        entries[text] = bytes.subarray(start, start + size);
        at += 46 + name + extra + comment;
    }
    return entries;
}

// The bytes of lossless pictures. By way of WebGL: a 2D canvas multiplies colours by alpha and loses digits.
async function texels(files) {
    const gl = new OffscreenCanvas(1, 1).getContext('webgl2');
    gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    const all = [];
    for (const bytes of files) {
        const options = { premultiplyAlpha: 'none', colorSpaceConversion: 'none' };
        const picture = await createImageBitmap(new Blob([bytes], { type: 'image/webp' }), options);
        const texture = gl.createTexture();
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, picture);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
        const out = new Uint8Array(4 * picture.width * picture.height);
        gl.readPixels(0, 0, picture.width, picture.height, gl.RGBA, gl.UNSIGNED_BYTE, out);
        gl.deleteTexture(texture);
        all.push(out);
    }
    gl.getExtension('WEBGL_lose_context')?.loseContext();
    return all;
}

// Per Gaussian 14 numbers in the file's coordinates: middle, axes divided by their standard deviations (row by row), opacity, reach.
const FLOATS = 14;

async function unpack(bytes) {
    const files = unzip(bytes);
    const meta = JSON.parse(new TextDecoder().decode(files['meta.json']));
    const names = [...meta.means.files, meta.scales.files[0], meta.quats.files[0], meta.sh0.files[0]];
    const [low, high, scales, quats, sh0] = await texels(names.map((n) => files[n]));
    const { mins, maxs } = meta.means;
    const out = new Float32Array(FLOATS * meta.count);
    for (let i = 0; i < meta.count; i++) {
        const p = 4 * i;
        const o = FLOATS * i;
        for (let k = 0; k < 3; k++) {
            const v = mins[k] + ((maxs[k] - mins[k]) * (low[p + k] + 256 * high[p + k])) / 65535;
            out[o + k] = Math.sign(v) * Math.expm1(Math.abs(v));
        }
        const q = [0, 0, 0, 0]; // w x y z
        const left = quats[p + 3] - 252;
        let sum = 0;
        for (let k = 0, j = 0; k < 4; k++) {
            if (k === left) continue;
            q[k] = (quats[p + j++] / 255 - 0.5) * Math.SQRT2;
            sum += q[k] * q[k];
        }
        q[left] = Math.sqrt(Math.max(0, 1 - sum));
        const [w, x, y, z] = q;
        const axes = [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
        ];
        let widest = 0;
        for (let k = 0; k < 3; k++) {
            const sigma = Math.exp(meta.scales.codebook[scales[p + k]]);
            widest = Math.max(widest, sigma);
            for (let j = 0; j < 3; j++) out[o + 3 + 3 * k + j] = axes[k][j] / sigma;
        }
        out[o + 12] = sh0[p + 3] / 255;
        out[o + 13] = 3.33 * widest; // beyond, the weight is below 1/255 of the opacity
    }
    return out;
}

// Distance along the ray (unit direction) to where half of the light is gone; null where it never is.
function halfLight(splats, from, to) {
    const hits = [];
    for (let o = 0; o < splats.length; o += FLOATS) {
        const x = splats[o] - from[0];
        const y = splats[o + 1] - from[1];
        const z = splats[o + 2] - from[2];
        const along = x * to[0] + y * to[1] + z * to[2];
        const reach = splats[o + 13];
        if (along < 0 || x * x + y * y + z * z - along * along > reach * reach) continue;
        let [dd, dx, xx] = [0, 0, 0];
        for (let k = o + 3; k < o + 12; k += 3) {
            const d = splats[k] * to[0] + splats[k + 1] * to[1] + splats[k + 2] * to[2];
            const e = splats[k] * x + splats[k + 1] * y + splats[k + 2] * z;
            dd += d * d;
            dx += d * e;
            xx += e * e;
        }
        const alpha = splats[o + 12] * Math.exp(-0.5 * Math.max(0, xx - (dx * dx) / dd));
        if (alpha > 1 / 255) hits.push([dx / dd, alpha]);
    }
    hits.sort((a, b) => a[0] - b[0]);
    let light = 1;
    for (const [distance, alpha] of hits) {
        light *= 1 - Math.min(alpha, 0.99);
        if (light < 0.5) return distance;
    }
    return null;
}
