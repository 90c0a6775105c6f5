// Constants of 3DGS rendering; the same as splatpainter/rendering/profiles.py, which explains them.
#pragma once
namespace sp { namespace {
constexpr double MIN_ALPHA = 1.0 / 255.0, MAX_ALPHA = 0.999, MIN_TRANSMITTANCE = 1e-4;
constexpr double PLAYCANVAS_MAX_ALPHA = 0.99, PLAYCANVAS_FALLOFF = 0.011108996538242306;
constexpr double NEAR_PLANE = 0.01, EPS2D = 0.3, MAX_DISTANCE_PX = 1e9;
} }  // namespace sp
