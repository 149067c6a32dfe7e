/*
 * Kernels of foveasim, with the same operations in the same order. Maps are float32; all sites are computed.
 *
 *     cc -O3 -march=native -ffp-contract=off -fno-math-errno -fno-trapping-math -shared -fPIC -o kernels.so kernels.c -lm
 */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* foveasim/integrate/_rectangle_kernels.py */

#define NO_COVERAGE 4e-15

/* First and last covered cell, their weights, and the moments of their covered parts. */
typedef struct { int64_t first, last; double w_first, w_last, m_first, m_last; } Covered;

static inline Covered covered_cells(double low, double high, int64_t n)
{
    Covered found = {0, -1, 0.0, 0.0, 0.0, 0.0};
    low = low > 0.0 ? low : 0.0;
    high = high < n ? high : n;
    if (!(high > low)) return found;
    int64_t first = (int64_t)floor(low), last = (int64_t)ceil(high) - 1;
    if (first < last && first + 1 - low <= NO_COVERAGE) low = ++first;
    if (first < last && high - last <= NO_COVERAGE) high = last--;
    found.first = first;
    found.last = last;
    if (first == last) {
        found.w_first = high - low;
        found.m_first = (high - low) * (0.5 * (low + high) - first - 0.5);
        return found;
    }
    found.w_first = first + 1 - low;
    found.w_last = high - last;
    found.m_first = 0.5 * found.w_first * (low - first);
    found.m_last = 0.5 * found.w_last * (high - last - 1.0);
    return found;
}

static inline double sum_cells(const float *line, int64_t c, int64_t stop)
{
    double total = 0.0;
    if (stop - c >= 16) {
        double a[8] = {0.0};
        for (; c + 8 <= stop; c += 8)
            for (int k = 0; k < 8; k++) a[k] += line[c + k];
        total = ((a[0] + a[1]) + (a[2] + a[3])) + ((a[4] + a[5]) + (a[6] + a[7]));
    }
    for (; c < stop; c++) total += line[c];
    return total;
}

static inline double along_row(const float *line, Covered u)
{
    double total = u.w_first * line[u.first];
    if (u.last > u.first) {
        total += u.w_last * line[u.last];
        if (u.last > u.first + 1) total += sum_cells(line, u.first + 1, u.last);
    }
    return total;
}

static inline double difference(const float *line, int64_t n, int64_t c)
{
    int64_t before = c > 0 ? c - 1 : 0, after = c + 1 < n ? c + 1 : c;
    double step = (double)line[after] - (double)line[before];
    return after > before + 1 ? 0.5 * step : step;
}

static inline double tilt(const float *cells, int64_t n_y, int64_t n_x, int64_t row, Covered u)
{
    int64_t below = row > 0 ? row - 1 : 0, above = row + 1 < n_y ? row + 1 : row;
    if (below == above) return 0.0;
    double step = along_row(cells + n_x * above, u) - along_row(cells + n_x * below, u);
    return above > below + 1 ? 0.5 * step : step;
}

static inline double integral(const float *cells, int64_t n_y, int64_t n_x, Covered u, Covered v, int64_t order)
{
    double total = 0.0;
    if (u.last < u.first) return total;
    for (int64_t row = v.first; row <= v.last; row++) {
        const float *line = cells + n_x * row;
        double weight = row == v.first ? v.w_first : row == v.last ? v.w_last : 1.0;
        double value = along_row(line, u);
        if (order == 2) {
            if (u.m_first != 0.0) value += u.m_first * difference(line, n_x, u.first);
            if (u.m_last != 0.0) value += u.m_last * difference(line, n_x, u.last);
        }
        total += weight * value;
    }
    if (order == 2 && v.last >= v.first) {
        if (v.m_first != 0.0) total += v.m_first * tilt(cells, n_y, n_x, v.first, u);
        if (v.m_last != 0.0) total += v.m_last * tilt(cells, n_y, n_x, v.last, u);
    }
    return total;
}

void gather_rectangles(const float *cells, int64_t n_y, int64_t n_x, const double *bounds, int64_t n_sites, double scale,
                       int64_t order, double *out)
{
    for (int64_t site = 0; site < n_sites; site++) {
        const double *box = bounds + 4 * site;
        Covered u = covered_cells(box[0], box[2], n_x), v = covered_cells(box[1], box[3], n_y);
        out[site] = scale * integral(cells, n_y, n_x, u, v, order);
    }
}

/* At first order; all columns cover cells. */
void gather_lattice(const float *cells, int64_t n_y, int64_t n_x, const double *u, int64_t n_columns, const double *v,
                    int64_t n_rows, double scale, double *out)
{
    int64_t *first = malloc(2 * n_columns * sizeof(int64_t)), *last = first + n_columns, done = -1;
    double *w_first = malloc(3 * n_columns * sizeof(double)), *w_last = w_first + n_columns, *along = w_last + n_columns;
    int is_narrow = 1;
    for (int64_t i = 0; i < n_columns; i++) {
        Covered column = covered_cells(u[2 * i], u[2 * i + 1], n_x);
        is_narrow &= column.last - column.first <= 1;
        first[i] = column.first, last[i] = column.last, w_first[i] = column.w_first, w_last[i] = column.w_last;
    }
    for (int64_t j = 0; j < n_rows; j++) {
        Covered rows = covered_cells(v[2 * j], v[2 * j + 1], n_y);
        double *sums = out + j * n_columns;
        for (int64_t i = 0; i < n_columns; i++) sums[i] = 0.0;
        for (int64_t row = rows.first; row <= rows.last; row++) {
            const float *line = cells + n_x * row;
            double weight = scale * (row == rows.first ? rows.w_first : row == rows.last ? rows.w_last : 1.0);
            if (row != done && !is_narrow)
                for (int64_t i = 0; i < n_columns; i++)
                    along[i] = along_row(line, (Covered){first[i], last[i], w_first[i], w_last[i], 0.0, 0.0});
            if (row != done && is_narrow)
                for (int64_t i = 0; i < n_columns; i++) along[i] = w_first[i] * line[first[i]] + w_last[i] * line[last[i]];
            done = row;
            for (int64_t i = 0; i < n_columns; i++) sums[i] += weight * along[i];
        }
    }
    free(first);
    free(w_first);
}

/* foveasim/integrate/_kernels.py */

#define TRACE_NO_COVERAGE 2e-15
#define BOX_CELLS 65536
#define MIN_RUN 12
#define BLOCK 8

static inline double least(double a, double b) { return b < a ? b : a; }
static inline double largest(double a, double b) { return b > a ? b : a; }
static inline int64_t least_index(int64_t a, int64_t b) { return b < a ? b : a; }

/* Cells of which the edges of a site are accumulated, and the touched columns of a row. */
typedef struct {
    int64_t n_y, n_x, bottom, top, left, n_columns, n_words, has_moments, n_touched, *columns;
    double (*rows)[3], (*cover)[2], (*moment)[3];
    uint64_t *touched;
} Box;

static inline void set_bits(uint64_t *words, int64_t first, int64_t last)
{
    for (int64_t k = first >> 6; k <= last >> 6; k++) {
        int64_t low = first > 64 * k ? first - 64 * k : 0, high = least_index(last - 64 * k, 63);
        words[k] |= (~(uint64_t)0 >> (63 - high + low)) << low;
    }
}

static inline void add_edge(const Box *box, double ua, double va, double ub, double vb)
{
    double sign = 1.0;
    if (va > vb) {
        double u = ua, v = va;
        ua = ub, va = vb, ub = u, vb = v, sign = -1.0;
    }
    if (va == vb || va >= box->top || vb <= box->bottom) return;
    double slope = (ub - ua) / (vb - va), steepness = ub != ua ? (vb - va) / fabs(ub - ua) : 0.0;
    if (!isfinite(steepness)) steepness = 0.0;
    double u_low = least(ua, ub), u_high = largest(ua, ub), end = least(vb, box->top);
    for (int64_t row = (int64_t)floor(largest(va, box->bottom)); row < end; row++) {
        double low = largest(va, row), high = least(vb, row + 1.0);
        double left_u = low == va ? ua : least(largest(ua + (low - va) * slope, u_low), u_high);
        double right_u = high == vb ? ub : least(largest(ua + (high - va) * slope, u_low), u_high);
        double v_left = low - (row + 0.5), direction = 1.0;
        if (left_u > right_u) {
            double u = left_u;
            left_u = right_u, right_u = u, v_left = high - (row + 0.5), direction = -1.0;
        }
        if (!(right_u > 0.0 || left_u == 0.0)) continue;
        double rise = high - low, u = largest(left_u, 0.0), climbed = (u - left_u) * steepness, before = climbed;
        int64_t i_row = row - box->bottom, first = (int64_t)least(u, box->n_x), column = first;
        for (int64_t cell = i_row * box->n_columns + first - box->left;; cell++, column++) {
            int is_last = right_u <= column + 1.0 || column == box->n_x;
            double u_next = is_last ? right_u : column + 1.0, height = is_last ? rise : (u_next - left_u) * steepness;
            double piece = sign * (height - climbed);
            box->cover[cell][0] += piece;
            if (column < box->n_x) box->cover[cell][1] += piece * (0.5 * (u + u_next) - column);
            if (box->has_moments) {
                double a = u - (column + 0.5), b = u_next - (column + 0.5), spread = (b - a) / 12.0;
                double va = v_left + direction * climbed, vb = v_left + direction * height;
                double u_mean = 0.5 * (a + b), v_mean = 0.5 * (va + vb);
                box->moment[cell][0] += piece * v_mean;
                box->moment[cell][1] += 0.5 * piece * (u_mean * u_mean + (b - a) * spread - 0.25);
                box->moment[cell][2] += piece * (v_mean * (u_mean + 0.5) + (vb - va) * spread);
            }
            if (is_last) break;
            u = u_next, climbed = height;
        }
        box->rows[i_row][0] += sign * (rise - before);
        box->rows[i_row][1] += rise;
        box->rows[i_row][2] += column - first + 1;
        set_bits(box->touched + i_row * box->n_words, first - box->left, column - box->left);
    }
}

static inline void list_touched(Box *box, int64_t i_row)
{
    box->n_touched = 0;
    for (int64_t k = 0; k < box->n_words; k++) {
        uint64_t word = box->touched[i_row * box->n_words + k];
        box->touched[i_row * box->n_words + k] = 0;
        for (; word; word &= word - 1) box->columns[box->n_touched++] = 64 * k + __builtin_ctzll(word);
    }
}

static inline double rounding_of(const double *row) { return TRACE_NO_COVERAGE * row[1] * largest(row[2] / 8.0, 1.0); }

/* Spans have the columns site, column, n_partial, n_run, row. */
static inline double write_row(const Box *box, int64_t i_row, int64_t site, int32_t (**spans)[5], double **weights)
{
    const double (*cover)[2] = (const double (*)[2])(box->cover + i_row * box->n_columns);
    double winding = box->rows[i_row][0], rounding = rounding_of(box->rows[i_row]), covered = 0.0;
    int64_t column = 0;
    int is_open = 0;
    for (int64_t k = 0; k < box->n_touched; k++) {
        int64_t at = box->columns[k], n_between = box->left + at - column;
        for (int is_touched = 0; is_touched < 2; is_touched++) {
            int64_t n_cells = is_touched ? box->left + at < box->n_x : n_between;
            double weight = is_touched ? cover[at][1] + (winding - cover[at][0]) : winding;
            if (is_touched) column = box->left + at;
            if (n_cells == 0) continue;
            if (fabs(weight) <= rounding) {
                is_open = 0;
                continue;
            }
            if (!is_open) {
                int32_t *span = *(*spans)++;
                span[0] = site, span[1] = column, span[2] = span[3] = 0, span[4] = box->bottom + i_row;
            }
            covered += weight * n_cells;
            is_open = is_touched || n_between < MIN_RUN;
            (*spans)[-1][is_open ? 2 : 3] += n_cells;
            for (int64_t i = is_open ? n_cells : 1; i > 0; i--) *(*weights)++ = weight;
        }
        winding -= cover[at][0];
        column = box->left + at + 1;
    }
    return covered;
}

static inline double gradient_scale(int64_t i, int64_t n) { return n == 1 ? 0.0 : 0 < i && i < n - 1 ? 0.5 : 1.0; }

/* Cuts have the columns site, column, row. */
static inline void write_cuts(const Box *box, int64_t i_row, int64_t site, int32_t (**cuts)[3], double (**moments)[2])
{
    const double (*moment)[3] = (const double (*)[3])(box->moment + i_row * box->n_columns);
    double tilt = 0.0, rounding = rounding_of(box->rows[i_row]);
    for (int64_t k = 0; k < box->n_touched; k++) tilt += moment[box->columns[k]][0];
    int64_t row = box->bottom + i_row, column = 0;
    for (int64_t k = 0; k < box->n_touched; k++) {
        int64_t at = box->columns[k], cell = box->left + at;
        if (fabs(tilt) <= rounding) column = cell;
        for (int64_t c = column; c < least_index(cell + 1, box->n_x); c++) {
            double along_u = c == cell ? moment[at][1] : 0.0;
            double along_v = c == cell ? moment[at][2] + (tilt - moment[at][0]) : tilt;
            along_u = fabs(along_u) > rounding ? along_u : 0.0;
            along_v = fabs(along_v) > rounding ? along_v : 0.0;
            if (along_u == 0.0 && along_v == 0.0) continue;
            int32_t *cut = *(*cuts)++;
            double *found = *(*moments)++;
            cut[0] = site, cut[1] = c, cut[2] = row;
            found[0] = along_u * gradient_scale(c, box->n_x), found[1] = along_v * gradient_scale(row, box->n_y);
        }
        tilt -= moment[at][0];
        column = cell + 1;
    }
}

static inline void find_box(Box *box, const double *uv, int64_t start, int64_t stop, int64_t *first_row, int64_t *last_row)
{
    double u_low = INFINITY, v_low = INFINITY, u_high = -INFINITY, v_high = -INFINITY;
    for (int64_t i = start; i < stop; i++) {
        u_low = least(u_low, uv[2 * i]), u_high = largest(u_high, uv[2 * i]);
        v_low = least(v_low, uv[2 * i + 1]), v_high = largest(v_high, uv[2 * i + 1]);
    }
    *first_row = *last_row = 0;
    if (!(v_high > 0.0 && v_low < box->n_y)) return;
    box->left = (int64_t)least(largest(u_low, 0.0), box->n_x);
    box->n_columns = (int64_t)least(largest(u_high, 0.0), box->n_x) - box->left + 1;
    box->n_words = (box->n_columns + 63) >> 6;
    *first_row = (int64_t)floor(largest(v_low, 0.0)), *last_row = (int64_t)ceil(least(v_high, box->n_y));
}

/* The lists have sufficient size; ``counts`` receives the numbers of spans, weights and cuts. */
void trace_sites(const double *uv, const int64_t *rings, const int64_t *sites, int64_t n_sites, int64_t first_site,
                 int64_t n_y, int64_t n_x, int64_t order, int32_t (*spans)[5], double *weights, int32_t (*cuts)[3],
                 double (*moments)[2], double *covered, int64_t *counts)
{
    int64_t n_cells = BOX_CELLS + n_x + 1;
    Box box = {n_y, n_x, .has_moments = order == 2, .columns = malloc((n_x + 1) * sizeof(int64_t))};
    box.rows = calloc(BOX_CELLS, sizeof *box.rows), box.cover = calloc(n_cells, sizeof *box.cover);
    box.moment = calloc(n_cells, sizeof *box.moment), box.touched = calloc(n_cells, sizeof(uint64_t));
    int32_t (*span)[5] = spans, (*cut)[3] = cuts;
    double *weight = weights;
    for (int64_t site = 0; site < n_sites; site++) {
        int64_t first_row, last_row;
        find_box(&box, uv, rings[sites[site]], rings[sites[site + 1]], &first_row, &last_row);
        covered[site] = 0.0;
        for (box.bottom = first_row; box.bottom < last_row; box.bottom = box.top) {
            int64_t step = BOX_CELLS / box.n_columns;
            box.top = least_index(box.bottom + (step > 1 ? step : 1), last_row);
            for (int64_t ring = sites[site]; ring < sites[site + 1]; ring++)
                for (int64_t b = rings[ring], a = rings[ring + 1] - 1; b < rings[ring + 1]; a = b++)
                    add_edge(&box, uv[2 * a], uv[2 * a + 1], uv[2 * b], uv[2 * b + 1]);
            for (int64_t i_row = 0; i_row < box.top - box.bottom; i_row++) {
                list_touched(&box, i_row);
                covered[site] += write_row(&box, i_row, first_site + site, &span, &weight);
                if (box.has_moments) write_cuts(&box, i_row, first_site + site, &cut, &moments);
                memset(box.rows[i_row], 0, sizeof *box.rows);
                for (int64_t k = 0; k < box.n_touched; k++) {
                    int64_t cell = i_row * box.n_columns + box.columns[k];
                    memset(box.cover[cell], 0, sizeof *box.cover);
                    if (box.has_moments) memset(box.moment[cell], 0, sizeof *box.moment);
                }
            }
        }
    }
    counts[0] = span - spans, counts[1] = weight - weights, counts[2] = cut - cuts;
    free(box.rows), free(box.cover), free(box.moment), free(box.touched), free(box.columns);
}

void gather(const float *cells, int64_t n_y, int64_t n_x, int64_t first_row, int64_t last_row, const int64_t *row_spans,
            const int64_t *row_weights, const int32_t (*spans)[4], const double *weights, const int64_t *row_cuts,
            const int32_t (*cuts)[2], const double (*moments)[2], double *slots)
{
    double *blocks = malloc((n_x / BLOCK + 1) * sizeof(double));
    for (int64_t row = first_row; row < last_row + 2; row++) {
        if (row >= first_row + 2) {
            int64_t at = row - 2;
            const float *line = cells + n_x * at, *below = at > 0 ? line - n_x : line, *above = at + 1 < n_y ? line + n_x : line;
            for (int64_t i = row_cuts[at]; i < row_cuts[at + 1]; i++) {
                int64_t c = cuts[i][1];
                double along_u = (double)line[c + 1 < n_x ? c + 1 : c] - (double)line[c > 0 ? c - 1 : 0];
                slots[cuts[i][0]] += moments[i][0] * along_u + moments[i][1] * ((double)above[c] - (double)below[c]);
            }
        }
        if (row >= last_row || row_spans[row] == row_spans[row + 1]) continue;
        const float *line = cells + n_x * row;
        for (int64_t b = 0; b < n_x / BLOCK; b++) {
            double total = 0.0;
            for (int k = 0; k < BLOCK; k++) total += line[b * BLOCK + k];
            blocks[b] = total;
        }
        const double *weight = weights + row_weights[row];
        for (int64_t i = row_spans[row]; i < row_spans[row + 1]; i++) {
            int64_t column = spans[i][1], n_partial = spans[i][2], end = column + n_partial + spans[i][3];
            double total = 0.0;
            for (int64_t k = 0; k < n_partial; k++) total += weight[k] * line[column + k];
            weight += n_partial, column += n_partial;
            if (end > column) {
                int64_t first_block = (column + BLOCK - 1) / BLOCK, last_block = end / BLOCK;
                double inside = 0.0;
                if (last_block > first_block) {
                    for (; column < first_block * BLOCK; column++) inside += line[column];
                    for (int64_t b = first_block; b < last_block; b++) inside += blocks[b];
                    column = last_block * BLOCK;
                }
                for (; column < end; column++) inside += line[column];
                total += *weight++ * inside;
            }
            slots[spans[i][0]] += total;
        }
    }
    free(blocks);
}

/* foveasim/_core/_kernels.py */

#define BATCH 1024
#define MASK 0xFFFFFFFFu

static inline void philox_4x32(uint64_t key, uint64_t counter, uint64_t last, uint64_t words[4])
{
    uint64_t key_0 = key & MASK, key_1 = key >> 32, a = counter & MASK, b = counter >> 32, c = 0, d = last;
    for (int round = 0; round < 10; round++) {
        uint64_t first = 0xD2511F53u * a, second = 0xCD9E8D57u * c;
        a = (second >> 32) ^ b ^ key_0, b = second & MASK, c = (first >> 32) ^ d ^ key_1, d = first & MASK;
        key_0 = (key_0 + 0x9E3779B9u) & MASK, key_1 = (key_1 + 0xBB67AE85u) & MASK;
    }
    words[0] = a, words[1] = b, words[2] = c, words[3] = d;
}

static inline double uniform(uint64_t word) { return ((double)(word >> 12) + 0.5) * 0x1p-52; }

static void fill_uniforms(uint64_t key, int64_t batch, double *first, double *second)
{
    for (int64_t j = 0; j < BATCH; j++) {
        uint64_t w[4];
        philox_4x32(key, batch * BATCH + j, 1, w);
        first[j] = uniform(w[0] << 32 | w[1]), second[j] = uniform(w[2] << 32 | w[3]);
    }
}

static inline int32_t bits_of(float value) { int32_t bits; memcpy(&bits, &value, 4); return bits; }
static inline float float_of(int32_t bits) { float value; memcpy(&value, &bits, 4); return value; }

static void fill_normals(uint64_t key, int64_t batch, float *out)
{
    uint32_t words[4][BATCH / 4], *radii = words[0], *angles = words[2];
    for (int64_t j = 0; j < BATCH / 4; j++) {
        uint64_t w[4];
        philox_4x32(key, batch * (BATCH / 4) + j, 0, w);
        for (int k = 0; k < 4; k++) words[k][j] = w[k];
    }
    const int32_t one = 0x3F800000, sqrt_half = 0x3F3504F3;
    const float ln_2 = (float)M_LN2, angle_of_bit = (float)(M_PI_4 * 0x1p-31);
    for (int64_t j = 0; j < BATCH / 2; j++) {
        float m = (float)radii[j] * 0x1p-32f + 0x1p-33f;
        int32_t bits = bits_of(m) + (one - sqrt_half), word = angles[j];
        float e = (float)((bits >> 23) - 127);
        m = float_of((bits & 0x7FFFFF) + sqrt_half);
        float t = (m - 1.0f) / (m + 1.0f), z = t * t;
        float log_m = t * (2.0f + z * (2.0f / 3 + z * (2.0f / 5 + z * (2.0f / 7 + z * (2.0f / 9)))));
        float radius = sqrtf(-(e * ln_2 + log_m)), angle = (float)(int32_t)((uint32_t)word << 2) * angle_of_bit;
        z = angle * angle;
        float sine = angle * (1.0f + z * (-1.0f / 6 + z * (1.0f / 120 + z * (-1.0f / 5040 + z * (1.0f / 362880)))));
        float cosine = 1.0f + z * (-1.0f / 2 + z * (1.0f / 24 + z * (-1.0f / 720 + z * (1.0f / 40320 + z * (-1.0f / 3628800)))));
        out[j] = copysignf(radius * (cosine + sine), (float)word);
        out[BATCH / 2 + j] = copysignf(radius * (cosine - sine), (float)(int32_t)((uint32_t)word << 1));
    }
}

/* foveasim/sensor/_kernels.py */

static inline double poisson(double mean, double first, double second, const double *cumulative, int64_t n_counts,
                             const uint16_t *guide, int64_t n_guide)
{
    int64_t row = (int64_t)mean, n = guide[row * n_guide + (int64_t)(first * n_guide)], added = 0;
    while (cumulative[row * n_counts + n] <= first) n++;
    double fraction = mean - row, probability = exp(-fraction), cumulated = probability;
    while (cumulated <= second && added < 20) {
        probability *= fraction / ++added;
        cumulated += probability;
    }
    return n + added;
}

void draw_poisson(double *charge_e, int64_t n_sites, double gaussian_above_e, const double *cumulative, int64_t n_counts,
                  const uint16_t *guide, int64_t n_guide, uint64_t key)
{
    float normals[BATCH], lowest = (float)gaussian_above_e;
    double first[BATCH], second[BATCH], drawn[BATCH];
    for (int64_t begin = 0; begin < n_sites; begin += BATCH) {
        double *charges = charge_e + begin;
        int64_t n = least_index(BATCH, n_sites - begin), n_exact = 0, n_zero = 0;
        for (int64_t j = 0; j < n; j++) n_exact += charges[j] <= gaussian_above_e, n_zero += charges[j] <= 0.0;
        if (n_exact < n) {
            fill_normals(key, begin / BATCH, normals);
            for (int64_t j = 0; j < n; j++) {
                float mean = (float)charges[j] > lowest ? (float)charges[j] : lowest, z = normals[j];
                float c = 1.0f / 6 + 11.0f / 648 / mean;
                float deviation = sqrtf(mean - 1.0f / 12 - 2.0f * c * c) * z + c * (z * z - 1.0f);
                drawn[j] = rint(least(largest(charges[j] + (double)deviation, 0.0), 0x1p62));
            }
        }
        if (n_exact > n_zero) fill_uniforms(key, begin / BATCH, first, second);
        for (int64_t j = 0; j < n; j++) {
            if (charges[j] > gaussian_above_e) charges[j] = drawn[j];
            else if (charges[j] > 0.0) charges[j] = poisson(charges[j], first[j], second[j], cumulative, n_counts, guide, n_guide);
            else charges[j] = 0.0;
        }
    }
}

static inline double quantise(double value, double n_codes)
{
    return (int32_t)least(largest(value + 1e-9, 0.0), n_codes - 1.0);
}

static inline double interpolate(const double *values, double position)
{
    int32_t k = (int32_t)position;
    return values[k] + (position - k) * (values[k + 1] - values[k]);
}

#define PIECE 512

/* Companding: linear, square root or logarithm. The numbers of codes, and of values of the curves, are integers. */
void convert(const double *voltage_v, const int32_t *lines, int64_t n_sites, double v_sat_v, int64_t companding,
             double log_strength, double n_codes, const double *inl, double n_inl, double dnl_dn, uint64_t dnl_key,
             const double *quantiles, double n_quantiles, uint16_t *codes)
{
    double value[PIECE], position[PIECE], log_range = log1p(log_strength);
    for (int64_t begin = 0; begin < n_sites; begin += PIECE, voltage_v += PIECE, lines += PIECE, codes += PIECE) {
        int64_t n = least_index(PIECE, n_sites - begin);
        for (int64_t j = 0; j < n; j++) value[j] = least(largest(voltage_v[j] / v_sat_v, 0.0), 1.0);
        if (companding == 1)
            for (int64_t j = 0; j < n; j++) value[j] = sqrt(value[j]);
        if (companding == 2)
            for (int64_t j = 0; j < n; j++) value[j] = log1p(log_strength * value[j]) / log_range;
        for (int64_t j = 0; j < n; j++) value[j] *= n_codes;
        if (n_inl > 1.0)
            for (int64_t j = 0; j < n; j++) {
                double at = least(value[j] * (1.0 / n_codes), 1.0) * (n_inl - 1.0);
                int32_t k = (int32_t)least(at, n_inl - 2.0);
                value[j] += inl[k] + (at - k) * (inl[k + 1] - inl[k]);
            }
        for (int64_t j = 0; j < n; j++) codes[j] = (int32_t)quantise(value[j], n_codes);
        if (dnl_dn > 0.0) {
            for (int64_t j = 0; j < n; j++) {
                uint64_t a = (uint32_t)lines[j], b = codes[j], weyl = dnl_key;
                for (int round = 0; round < 10; round++) {
                    uint64_t product = 0xD256D193u * a;
                    a = (product >> 32) ^ weyl ^ b, b = product & MASK;
                    weyl = (weyl + 0x9E3779B9u) & MASK;
                }
                position[j] = (double)a * (0x1p-32 * (n_quantiles - 1.0));
            }
            for (int64_t j = 0; j < n; j++)
                codes[j] = (int32_t)quantise(value[j] + dnl_dn * interpolate(quantiles, position[j]), n_codes);
        }
    }
}
