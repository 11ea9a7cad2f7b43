% A reconstruction core as a command, for Octave and MATLAB: the axis of the
% cone of sightlines through the isophote at half of the peak.
%
%   octave-cli -qf core.m           arrays on standard input
%   octave-cli -qf core.m files     arrays as files in a folder
%   matlab -batch "transport = 'files'; run('core.m')"
%
% MATLAB before R2024a wants a script's functions at its end: move the lines
% below the functions to the place of the first, `1;`.
%
% To make your own, keep the rest and replace `estimate`.
% docs/reference/cores.md describes the protocol.

1;

function answer_requests(transport)
% Greet, then answer each request until standard input closes.
  wanted = 'isophote_rays_0.5';
  if is_octave()
    in = stdin;
  else
    in = fopen('/dev/stdin', 'r');
  end
  while true
    line = next_line(in);
    if ~ischar(line)
      break  % standard input has closed
    end
    header = jsondecode(line);
    if strcmp(header.type, 'hello')
      send(sprintf(['{"type":"hello","protocol":1,"name":"cone_axis_octave","version":"1.0",' ...
                    '"kind":"patch","transport":"%s","arrays":["%s"],"isophotes":[0.5]}'], transport, wanted));
    elseif strcmp(transport, 'files')
      request = jsondecode(fileread(fullfile(header.folder, 'request.json')));
      rays = [];
      file = fullfile(header.folder, [wanted '.npy']);
      if exist(file, 'file')
        rays = read_npy(file);
      end
      out = fopen(fullfile(header.folder, 'answer.json'), 'w');
      fprintf(out, '%s\n', estimate(rays, request.id));
      fclose(out);
      send(sprintf('{"type":"done","id":%d}', header.id));
    else
      rays = [];
      if isfield(header, 'arrays') && ~isempty(header.arrays)  % one at most: the only one that the hello asks for
        shape = header.arrays(1).shape(:)';
        rays = reshape(fread(in, prod(shape), 'double', 0, 'ieee-le'), fliplr(shape))';
      end
      send(estimate(rays, header.id));
    end
  end
end

function line = next_line(in)
% Return the next line of standard input; -1 where it has closed.
  if ~is_octave()
    line = fgetl(in);
    return
  end
  try
    line = input('', 's');  % Octave's fgetl waits for the first byte of the line after
  catch
    line = -1;
  end
end

function answer = estimate(rays, id)
% Return the answer, as JSON, to the rays of an isophote, N x 3; [] where there is none.
  if isempty(rays)
    answer = failure(id, 'no_closed_isophote', 'the isophote was not sent');
    return
  end
  if all(rays(1, :) == rays(end, :))
    rays = rays(1:end - 1, :);  % the polygon is closed; its first point counts once
  end
  if size(rays, 1) < 6
    answer = failure(id, 'too_few_points', sprintf('%d points; at least 6 are needed', size(rays, 1)));
    return
  end

  % a gnomonic plane across the middle of the rays, centred and scaled so that the fit is well conditioned
  middle = sum(rays, 1);
  middle = middle / norm(middle);
  frame = [across(middle); middle];
  p = rays * frame';
  x = p(:, 1) ./ p(:, 3);
  y = p(:, 2) ./ p(:, 3);
  cx = mean(x);
  cy = mean(y);
  scale = sqrt(mean((x - cx).^2 + (y - cy).^2));
  x = (x - cx) / scale;
  y = (y - cy) / scale;
  if mean(x.^2) * mean(y.^2) - mean(x .* y)^2 < 1e-9
    answer = failure(id, 'degenerate_conic', 'the points lie on a line');
    return
  end

  % the ellipse (1 + p) x^2 + 2 q x y + (1 - p) y^2 + d x + e y + f = 0, by least squares
  M = [x.^2 - y.^2, 2 * x .* y, x, y, ones(size(x))];
  s = (M' * M) \ (-M' * (x.^2 + y.^2));
  if s(1)^2 + s(2)^2 >= 1
    answer = failure(id, 'not_an_ellipse', sprintf('the fitted conic is no ellipse: p^2 + q^2 = %.3g', s(1)^2 + s(2)^2));
    return
  end
  conic = [1 + s(1), s(2), s(3) / 2; s(2), 1 - s(1), s(4) / 2; s(3) / 2, s(4) / 2, s(5)];

  % the cone w' C w = 0 of camera directions w, and its axis: the eigenvector of the one negative eigenvalue
  plane = [1 / scale, 0, -cx / scale; 0, 1 / scale, -cy / scale; 0, 0, 1] * frame;
  C = plane' * conic * plane;
  [vectors, values] = eig((C + C') / 2);
  [values, order] = sort(diag(values));
  if ~(values(1) < 0 && 0 < values(2))
    answer = failure(id, 'degenerate_conic', sprintf('eigenvalues %.3g, %.3g, %.3g', values));
    return
  end
  axis = vectors(:, order(1))';
  if axis * middle' < 0
    axis = -axis;
  end
  % A light at the camera: where the normal points back along the sightline, the reflection is brightest.
  answer = sprintf(['{"type":"estimate","id":%d,"normal":[%.17g,%.17g,%.17g],' ...
                    '"look_ray":[%.17g,%.17g,%.17g],"axis_ratio":%.17g}'], id, -axis, axis, sqrt(values(2) / values(3)));
end

function rows = across(direction)
% Return two unit vectors, rows, that are perpendicular to a unit vector and to each other.
  x = direction(1);
  y = direction(2);
  z = direction(3);
  sgn = 1;
  if z < 0
    sgn = -1;
  end
  a = -1 / (sgn + z);
  b = x * y * a;
  rows = [1 + sgn * x * x * a, sgn * b, -sgn * x; b, sgn + y * y * a, -y];
end

function answer = failure(id, reason, detail)
% Return the answer that there is no normal, and why, as JSON.
  answer = sprintf('{"type":"failure","id":%d,"reason":"%s","detail":"%s"}', id, reason, detail);
end

function send(text)
% Write one line to standard output, at once.
  fprintf('%s\n', text);
  if is_octave()
    fflush(stdout);
  end
end

function values = read_npy(file)
% Read a matrix of doubles, as numpy.save writes it: little-endian, version 1 or 2, C order.
  in = fopen(file, 'r', 'ieee-le');
  start = fread(in, 8, 'uint8');
  if start(7) == 1
    count = fread(in, 1, 'uint16');
  else
    count = fread(in, 1, 'uint32');
  end
  text = fread(in, count, 'uint8=>char')';
  if isempty(strfind(text, '<f8'))
    error('%s: must hold doubles', file);
  end
  shape = regexp(text, '''shape'':\s*\((\d+),\s*(\d+)', 'tokens');
  shape = [str2double(shape{1}{1}), str2double(shape{1}{2})];
  values = reshape(fread(in, prod(shape), 'double'), fliplr(shape))';
  fclose(in);
end

function yes = is_octave()
  yes = exist('OCTAVE_VERSION', 'builtin') ~= 0;
end

if ~exist('transport', 'var')
  transport = 'stream';
end
if is_octave() && any(strcmp(argv(), 'files'))
  transport = 'files';
end
answer_requests(transport);
