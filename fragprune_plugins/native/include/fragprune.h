/* The C interface of fragprune's rasterizers: plain pointers, no Python, no torch.
 *
 * All arrays are contiguous float32 (or the integer type named) in row-major order, N Gaussians.
 * Matrices act on row vectors, as the hosts keep them: p_view = [p, 1] * viewmatrix.
 * Functions keep no state of their own and may be called from several threads at once. Every struct
 * begins with its own size, so that a caller built against another version is refused, not misread.
 */
#ifndef FRAGPRUNE_H
#define FRAGPRUNE_H

#include <stdint.h>

#define FRAGPRUNE_API_VERSION 11

/* The field's constants and ours; fragprune_plugins/constants.py says why, a test compares the two. */
#define FRAGPRUNE_ALPHA_MIN (1.0 / 255.0)
#define FRAGPRUNE_ALPHA_MAX 0.99
#define FRAGPRUNE_TRANSMITTANCE_MIN 1e-4
#define FRAGPRUNE_STOPPED_ALPHA_MAX 0.999
#define FRAGPRUNE_NEAR 0.2
#define FRAGPRUNE_TILE 16
#define FRAGPRUNE_DILATION 0.3
#define FRAGPRUNE_FRUSTUM_MARGIN 1.3
#define FRAGPRUNE_ANTIALIASING_FLOOR 2.5e-5
#define FRAGPRUNE_MIP_FLOOR 1e-6
#define FRAGPRUNE_FEATURES_MAX 8
#define FRAGPRUNE_COEFFICIENTS_MAX 1024
#define FRAGPRUNE_THREADS_MAX 1024
#define FRAGPRUNE_RIM_WIDTH 0.01
#define FRAGPRUNE_RIM_REACH 4.6
#define FRAGPRUNE_FALLOFF_MIN 1e-4
#define FRAGPRUNE_NEUTRAL_LOGIT -30.0
#define FRAGPRUNE_MARGINAL_MIN 0.05

#if defined(_WIN32)
#define FRAGPRUNE_EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define FRAGPRUNE_EXPORT __attribute__((visibility("default")))
#else
#define FRAGPRUNE_EXPORT
#endif

#ifdef __cplusplus
extern "C" {
#endif

enum fragprune_status {
  FRAGPRUNE_OK = 0,
  FRAGPRUNE_BAD_INPUT = 1,
  FRAGPRUNE_OUT_OF_MEMORY = 2,
  FRAGPRUNE_TOO_LARGE = 3,
  FRAGPRUNE_FAILED = 4
};

/* Factor on opacity by the determinants d0, d1 of the 2D covariance before and after dilation. */
enum fragprune_compensation {
  FRAGPRUNE_NO_COMPENSATION = 0,
  FRAGPRUNE_ANTIALIASING = 1, /* sqrt(max(2.5e-5, d0 / d1)) */
  FRAGPRUNE_MIP = 2           /* sqrt(d0 / (d1 + 1e-6) + 1e-6); 0 where either is at most 1e-6 */
};

/* Bits of fragprune_cpu_features: what the machine runs, not what this build uses. */
enum fragprune_cpu_feature { FRAGPRUNE_CPU_AVX2 = 1, FRAGPRUNE_CPU_AVX512 = 2 };

typedef struct fragprune_error {
  char message[256]; /* empty unless the status is not FRAGPRUNE_OK */
} fragprune_error;

typedef struct fragprune_workspace fragprune_workspace;

/* How many numbers each input array holds, by its name in fragprune_inputs or fragprune_spacetime; 0
 * for NULL. A call is refused, and nothing read, where one holds more or fewer than the shape that is
 * named there takes. */
typedef struct fragprune_lengths {
  int64_t viewmatrix;
  int64_t projmatrix;
  int64_t campos;
  int64_t background;
  int64_t means;
  int64_t opacities;
  int64_t scales;
  int64_t rotations;
  int64_t cov3d;
  int64_t sh;
  int64_t colors;
  int64_t features;
  int64_t thresholds;
  int64_t sample_offsets;
  int64_t means2d;
  int64_t conics;
  int64_t depths;
  int64_t tiles;
  int64_t times;
  int64_t scales_t;
  int64_t rotations_r;
  int64_t sh_rest;
} fragprune_lengths;

/* N Gaussians are given in the world (means, scales and rotations or cov3d, sh or colors) or, when
 * means2d is not NULL, on the image (means2d, conics, depths, tiles, colors): then neither the camera
 * nor what belongs to projection is read, and one draws nothing that has no tiles, a depth that is not
 * positive or a conic that is not positive definite.
 *
 * A Gaussian with a threshold ends hard: a pixel's centre is inside or not. With `soft`, alpha is times
 * clamp(1/2 + d, 0, 1), d = (e - e_rim) / |gradient of e on the image|, e = ln(falloff), e_rim =
 * ln(threshold): the distance of the pixel's centre to the rim, pixels. A fragment is drawn where that
 * is above 0.
 *
 * With `flat` they are surfels, flat Gaussians in the plane of their first two axes, drawn by the rules
 * of 2D Gaussian Splatting: given in the world by scales and rotations, without dilation, compensation,
 * features, sample_offsets and absolute_gradient. */
typedef struct fragprune_inputs {
  uint32_t size;           /* sizeof(fragprune_inputs) */
  int32_t threads;         /* 1 to 1024; results do not depend on it */
  int32_t width;           /* pixels */
  int32_t height;          /* pixels */
  float tan_fov_x;         /* tangent of half the field of view */
  float tan_fov_y;
  float scale_modifier;    /* factor on scales; does not apply to cov3d */
  float dilation;          /* pixels^2 added to the 2D covariance's diagonal */
  float near;              /* Gaussians at this view depth or less are culled; 0 or more */
  float alpha_max;         /* alpha is capped here; 1/255 to 1, or to 0.999 with a stop */
  float stop;              /* 1e-4 to 1: a pixel draws the fragment that leaves less of its light, and
                              stops behind it, and gradients take what it leaves out to look like that
                              fragment; 0: it stops before one that would leave less than 1e-4 */
  int32_t compensation;    /* enum fragprune_compensation */
  int32_t cap_gradient;    /* the gradient passes through the cap; else it is 0 where capped */
  int32_t absolute_gradient; /* fill the hook's third column, see fragprune_input_grads */
  int32_t sh_degree;       /* 0 to 3 */
  int32_t sh_coefficients; /* K, coefficients of a Gaussian; 0 to 1024 */
  int32_t feature_count;   /* F, 0 to 8 */
  int32_t widen;           /* keep rim fragments: thresholds will want a gradient */
  int32_t flat;            /* surfels: scales are (N, 2), see below; the cpu engine's alone */
  int32_t soft;            /* rims cover pixels in part, see below; the cpu engine's alone */
  int64_t count;           /* N */
  fragprune_lengths lengths;
  const float *viewmatrix; /* (4, 4) */
  const float *projmatrix; /* (4, 4) */
  const float *campos;     /* (3) */
  const float *background; /* (3) */
  const float *means;      /* (N, 3) */
  const float *opacities;  /* (N) */
  const float *scales;     /* (N, 3), or (N, 2) of surfels, with rotations; or NULL */
  const float *rotations;  /* (N, 4) w x y z, used as given; or NULL */
  const float *cov3d;      /* (N, 6) xx xy xz yy yz zz; or NULL */
  const float *sh;         /* (N, K, 3), or (N, 1, 3) with sh_rest; or NULL */
  const float *sh_rest;    /* (N, K - 1, 3); or NULL. The cpu engine's alone */
  const float *colors;     /* (N, 3); or NULL */
  const float *features;   /* (N, F), blended as colour is; or NULL: F is 0 */
  const float *thresholds; /* (N) falloff in (0, 1); or NULL: no truncation */
  const float *sample_offsets; /* (H, W, 2) x, y: where in its pixel each is sampled; or NULL */
  const float *means2d;    /* (N, 2) pixels, (0, 0) the centre of the first; or NULL */
  const float *conics;     /* (N, 3) inverse covariances xx xy yy, pixels^-2; or NULL */
  const float *depths;     /* (N) drawn in this order; or NULL */
  const int32_t *tiles;    /* (N, 4) x0 y0 x1 y1, half open, of tiles; or NULL */
  fragprune_workspace *workspace; /* memory to use again; or NULL */
} fragprune_inputs;

/* NULL pointers: not wanted. */
typedef struct fragprune_outputs {
  uint32_t size;
  float *image;                    /* (3, H, W) with background */
  float *invdepth;                 /* (H, W) sum of alpha T / z */
  float *alpha;                    /* (H, W) 1 - final transmittance */
  int32_t *radii;                  /* (N) the host's rule; thresholds never change it */
  float *features;                 /* (F, H, W) sum of alpha T feature */
  int32_t *fragments;              /* (H, W) drawn fragments */
  int32_t *fragments_per_gaussian; /* (N) drawn fragments */
  float *weights_per_gaussian;     /* (N) sum of alpha T over drawn fragments */
  int32_t *wins_per_gaussian;      /* (N) pixels where its alpha T is the largest */
  int32_t *winners;                /* (H, W) row of the largest, the first of equals; -1 for none */
  float *surface;                  /* (6, H, W) of surfels: sum of alpha T depth, of alpha T normal (3,
                                      view space), the median depth, the distortion */
  int64_t drawn;                   /* filled in: fragments drawn */
  int64_t evaluated;               /* filled in: lanes spent on (Gaussian, pixel) pairs */
  int64_t entries;                 /* filled in: (Gaussian, tile) pairs that were blended */
  float projection_ms;             /* filled in: time of each stage */
  float binning_ms;
  float blend_ms;
} fragprune_outputs;

/* Gradients of a loss with respect to the outputs; NULL stands for zero. */
typedef struct fragprune_output_grads {
  uint32_t size;
  float fragments_per_pixel; /* of drawn / (width * height) */
  const float *image;        /* (3, H, W) */
  const float *invdepth;     /* (H, W) */
  const float *alpha;        /* (H, W) */
  const float *features;     /* (F, H, W) */
  const float *surface;      /* (6, H, W) */
} fragprune_output_grads;

/* Where to put gradients; NULL: not wanted, and not computed. Every element is written. */
typedef struct fragprune_input_grads {
  uint32_t size;
  float *means;      /* (N, 3) */
  float *hook;       /* (N, 3) gx, gy of the mean on the image, times (W/2, H/2), then 0 or, with
                        absolute_gradient, the sum of |gx| + |gy| of single pixels; of surfels, of
                        what moves the plane, as their rasterizer has it */
  float *opacities;  /* (N) */
  float *scales;     /* (N, 3), or (N, 2) of surfels */
  float *rotations;  /* (N, 4) */
  float *cov3d;      /* (N, 6) */
  float *sh;         /* (N, K, 3), or (N, 1, 3) with sh_rest */
  float *sh_rest;    /* (N, K - 1, 3) */
  float *colors;     /* (N, 3) */
  float *features;   /* (N, F) */
  float *thresholds; /* (N) */
  float *means2d;    /* (N, 2) */
  float *conics;     /* (N, 3) */
  float *depths;     /* (N) */
  float *background; /* (3) */
} fragprune_input_grads;

/* What backward needs to know of one forward. Immutable: backward may run any number of times. */
typedef struct fragprune_state fragprune_state;

/* Draws. With state not NULL, *state receives what backward needs; it refers to the arrays of
 * `inputs`, which must stay as they are until fragprune_free. */
FRAGPRUNE_EXPORT int fragprune_forward(const fragprune_inputs *inputs, fragprune_outputs *outputs,
                                       fragprune_state **state, fragprune_error *error);

FRAGPRUNE_EXPORT int fragprune_backward(const fragprune_state *state,
                                        const fragprune_output_grads *output_grads,
                                        const fragprune_input_grads *input_grads, int32_t threads,
                                        fragprune_error *error);

FRAGPRUNE_EXPORT void fragprune_free(fragprune_state *state); /* NULL is fine */

/* N Gaussians in space and time, and the moment at which to cut them. How they are given:
 *   cov3d                      sliced already; only colours depend on the moment
 *   scales, rotations          in space alone
 *   with times, scales_t       and, apart from it, in time: scales_t is a variance then
 *   with rotations_r as well   with axes anywhere in space and time, turned by both quaternions */
typedef struct fragprune_spacetime {
  uint32_t size;
  int32_t threads;         /* 1 to 1024; results do not depend on it */
  float timestamp;         /* the moment */
  float duration;          /* of the cosines' longest period; above 0 */
  float prefilter_var;     /* when positive, added to the variance in time that the marginal sees */
  float scale_modifier;    /* factor on scales and scales_t */
  int32_t sh_degree;       /* 0 to 3 */
  int32_t sh_degree_t;     /* cosines in use at sh_degree 3, 0 to 2; -1: colours know no time */
  int32_t sh_coefficients; /* K: (sh_degree + 1)^2 or more, and 16 more for each cosine; to 1024 */
  int64_t count;           /* N */
  fragprune_lengths lengths;
  const float *campos;     /* (3) */
  const float *means;      /* (N, 3) */
  const float *opacities;  /* (N) */
  const float *times;      /* (N) means in time; or NULL */
  const float *scales;     /* (N, 3); or NULL */
  const float *scales_t;   /* (N); or NULL */
  const float *rotations;  /* (N, 4) w x y z, used as given; or NULL */
  const float *rotations_r; /* (N, 4); or NULL */
  const float *cov3d;      /* (N, 6) xx xy xz yy yz zz; or NULL */
  const float *sh;         /* (N, K, 3), 16 to each cosine; or NULL: no colours */
} fragprune_spacetime;

/* 3D Gaussians, or gradients by them; NULL stands for zero there. One whose marginal is at most 0.05
 * or whose covariance is not finite is not there: its mean is campos, where nothing is drawn, and the
 * rest is zero. */
typedef struct fragprune_sliced {
  uint32_t size;
  float *means;     /* (N, 3) */
  float *cov3d;     /* (N, 6) */
  float *opacities; /* (N) times the marginal */
  float *colors;    /* (N, 3) not below 0; NULL when no sh is given */
  uint8_t *present; /* (N) 1, or 0: not there; needed in both directions */
} fragprune_sliced;

/* Where to put gradients; NULL: not wanted. Every element is written. */
typedef struct fragprune_spacetime_grads {
  uint32_t size;
  float *means;       /* (N, 3) */
  float *opacities;   /* (N) */
  float *times;       /* (N) */
  float *scales;      /* (N, 3) */
  float *scales_t;    /* (N) */
  float *rotations;   /* (N, 4) */
  float *rotations_r; /* (N, 4) */
  float *cov3d;       /* (N, 6) */
  float *sh;          /* (N, K, 3) */
} fragprune_spacetime_grads;

/* Cuts Gaussians at a moment. Nothing is kept: for the way back the same inputs are given again. */
FRAGPRUNE_EXPORT int fragprune_slice(const fragprune_spacetime *inputs,
                                     const fragprune_sliced *outputs, fragprune_error *error);

FRAGPRUNE_EXPORT int fragprune_unslice(const fragprune_spacetime *inputs,
                                       const fragprune_sliced *output_grads,
                                       const fragprune_spacetime_grads *input_grads,
                                       fragprune_error *error);

/* Two images and what differs between them: l1_weight * l1 + ssim_weight * dissimilarity. Structural
 * similarity is that of the hosts: an 11x11 Gaussian window of sigma 1.5, zero outside the image,
 * C1 = 0.01^2, C2 = 0.03^2, each channel for itself. NaN in a pixel is NaN in what is filled in. */
typedef struct fragprune_photometric {
  uint32_t size;
  int32_t threads;     /* 1 to 1024; results do not depend on it */
  int32_t channels;    /* C, 1 to 65536 */
  int32_t height;      /* pixels, 1 to 65536 */
  int32_t width;
  float l1_weight;
  float ssim_weight;
  const float *image;  /* (C, H, W) */
  const float *target; /* (C, H, W) */
  float *gradient;     /* (C, H, W) of the weighted sum, by the image; or NULL: not wanted */
  fragprune_workspace *workspace; /* memory to use again; or NULL */
  double l1;            /* filled in: mean absolute difference */
  double dissimilarity; /* filled in: 1 - mean structural similarity */
} fragprune_photometric;

FRAGPRUNE_EXPORT int fragprune_photometric_loss(fragprune_photometric *images,
                                                fragprune_error *error);

/* Memory that calls hand on to the next ones, so that the system need not find and clear it each
 * time. Any number of calls may use one workspace at once; the states that came of them may outlive
 * it. What lies idle is bounded by what was lately in use. NULL: out of memory, which is no harm. */
FRAGPRUNE_EXPORT fragprune_workspace *fragprune_workspace_new(void);
FRAGPRUNE_EXPORT void fragprune_workspace_free(fragprune_workspace *workspace); /* NULL is fine */

/* Memory for a caller's own arrays, images for example: `bytes` of it, 64-byte aligned, or NULL.
 * Given back to the workspace it came from, with the same number. */
FRAGPRUNE_EXPORT void *fragprune_workspace_take(fragprune_workspace *workspace, uint64_t bytes);
FRAGPRUNE_EXPORT void fragprune_workspace_give(fragprune_workspace *workspace, void *memory,
                                               uint64_t bytes);

FRAGPRUNE_EXPORT int fragprune_version(void); /* FRAGPRUNE_API_VERSION of this build */
FRAGPRUNE_EXPORT int fragprune_lanes(void);   /* pixels handled by one instruction */
FRAGPRUNE_EXPORT int fragprune_cpu_features(void);

#ifdef __cplusplus
}
#endif

#endif
