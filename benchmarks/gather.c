/*
 * Integrals of a float32 map over rectangles, as foveasim/integrate/_rectangle_kernels.py: the same operations in the same order.
 *
 *     cc -O3 -march=native -ffp-contract=off -shared -fPIC -o gather.so gather.c -lm
 */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>

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
