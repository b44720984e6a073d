// Reads a QR code that is drawn with block characters: node qr.mjs FILE. Prints its text.

import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';

const require = createRequire(`${process.env.ZTL_CLIENTS}/`);
const { default: read } = require('jsqr');

// Each character is one module wide and two high.
const HALVES = { ' ': [0, 0], '▀': [1, 0], '▄': [0, 1], '█': [1, 1] };
const SCALE = 4;
const lines = readFileSync(process.argv[2], 'utf8').split('\n').map((line) => [...line]);
const width = Math.max(...lines.map((line) => line.length));
const modules = lines.flatMap((line) => [0, 1].map((half) => Array.from({ length: width }, (_, at) => HALVES[line[at] ?? ' '][half])));
const pixels = new Uint8ClampedArray(modules.length * width * SCALE * SCALE * 4).fill(255);
const wide = width * SCALE;
for (let y = 0; y < modules.length * SCALE; y += 1) {
  for (let x = 0; x < wide; x += 1) {
    if (modules[Math.floor(y / SCALE)][Math.floor(x / SCALE)]) pixels.fill(0, (y * wide + x) * 4, (y * wide + x) * 4 + 3);
  }
}
console.log(read(pixels, wide, modules.length * SCALE).data);
