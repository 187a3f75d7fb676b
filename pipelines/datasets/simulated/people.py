"""Walkers: people in mid-stride, as rigid figures of head, hair, torso, arms, legs and shoes.

A walker's origin is the centre of its box, x right, y down, z forward (the way it walks).
"""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.datasets.simulated.meshes import Mesh, ellipsoid, limb, merge

Colour = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Clothes:
    """Colours of one person. top_texture: `cloth` or `stripes`; bag: colour of a rucksack."""

    top: Colour
    legs: Colour
    skin: Colour
    hair: Colour
    shoes: Colour = (52, 46, 44)
    top_texture: str = "cloth"
    bag: Colour | None = None


WARDROBE: tuple[Clothes, ...] = (
    Clothes((178, 52, 46), (48, 58, 84), (226, 178, 148), (72, 48, 34), bag=(66, 84, 62)),
    Clothes((58, 96, 148), (92, 84, 74), (150, 106, 78), (34, 28, 26), top_texture="stripes"),
    Clothes((214, 178, 74), (52, 52, 58), (236, 192, 164), (178, 134, 74), (230, 230, 228)),
    Clothes((72, 116, 86), (64, 74, 104), (112, 76, 56), (26, 22, 22), bag=(150, 64, 48)),
    Clothes((206, 204, 198), (128, 104, 78), (232, 184, 156), (120, 112, 108)),
    Clothes((118, 72, 122), (40, 44, 54), (206, 156, 124), (44, 32, 28), top_texture="stripes"),
)


def walker_mesh(clothes: Clothes, height_m: float = 1.74) -> Mesh:
    """A person of some 800 triangles, 1.74 m tall unless told."""
    top, skin = clothes.top_texture, clothes.skin
    parts = [
        ellipsoid((0.082, 0.115, 0.1), "plain", skin, (0, -1.6, 0.02), 10, 14),
        ellipsoid((0.09, 0.085, 0.105), "plain", clothes.hair, (0, -1.655, -0.015), 8, 14),
        ellipsoid((0.018, 0.025, 0.03), "plain", skin, (0, -1.585, 0.115), 4, 6),
        limb([(0, -1.52, 0), (0, -1.42, 0)], (0.055, 0.065), "plain", skin),
        ellipsoid((0.205, 0.17, 0.12), top, clothes.top, (0, -1.31, 0), 8, 14),
        limb([(-0.07, -1.28, 0), (-0.06, -0.97, 0)], (0.125, 0.115), top, clothes.top, 12),
        limb([(0.07, -1.28, 0), (0.06, -0.97, 0)], (0.125, 0.115), top, clothes.top, 12),
        ellipsoid((0.175, 0.13, 0.125), "cloth", clothes.legs, (0, -0.93, 0), 8, 12),
    ]
    for side, swing in ((-1, 1), (1, -1)):
        hip, knee = (side * 0.09, -0.9, 0), (side * 0.095, -0.49, swing * 0.16 + 0.05)
        ankle = (side * 0.095, -0.1, swing * 0.3 - 0.02)
        parts.append(limb([hip, knee, ankle], (0.1, 0.07, 0.052), "cloth", clothes.legs, 10))
        foot = (side * 0.1, -0.05, swing * 0.3 + 0.05)
        parts.append(ellipsoid((0.05, 0.05, 0.135), "plain", clothes.shoes, foot, 6, 10))
        shoulder, elbow = (side * 0.215, -1.4, 0), (side * 0.27, -1.13, -swing * 0.09 - 0.02)
        wrist = (side * 0.26, -0.92, -swing * 0.19 + 0.08)
        parts.append(limb([shoulder, elbow], (0.062, 0.052), top, clothes.top, 10))
        parts.append(limb([elbow, wrist], (0.048, 0.036), "plain", skin, 8))
        hand = (wrist[0], wrist[1] + 0.06, wrist[2] + 0.02)
        parts.append(ellipsoid((0.03, 0.065, 0.045), "plain", skin, hand, 6, 8))
    if clothes.bag:
        parts.append(ellipsoid((0.15, 0.22, 0.1), "cloth", clothes.bag, (0, -1.2, -0.17), 8, 12))
    mesh = merge(parts)
    mesh.vertices[:] *= height_m / 1.74
    low, high = mesh.bounds()
    mesh.vertices[:] -= (low + high) / 2
    return mesh
